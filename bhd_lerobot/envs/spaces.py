"""Observation and action spaces."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.errors import ActionError
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.task import Task


def observation_space(simulation: Simulation, task: Task, parts: tuple[str, ...]) -> spaces.Dict:
    """Return the space of one simulation's observations, with LeRobot's keys.

    `agent_pos`: the robot's floats, shape (k,). `environment_state`: what the task reports, shape (e,), if it reports
    anything. `pixels`: images by camera name, shape (height, width, 3), if cameras are observed.
    """
    members: dict[str, spaces.Space[Any]] = {}
    if "agent_pos" in parts:
        members["agent_pos"] = _state_space(simulation)
    if "environment_state" in parts and task.environment_names:
        members["environment_state"] = spaces.Box(-np.inf, np.inf, (len(task.environment_names),), np.float32)
    if "pixels" in parts and simulation.camera_names:
        members["pixels"] = spaces.Dict(
            {name: spaces.Box(0, 255, shape, np.uint8) for name, shape in simulation.camera_shapes.items()}
        )
    return spaces.Dict(members)


def _state_space(simulation: Simulation) -> spaces.Box:
    names, body = simulation.observation_names, simulation.body
    low = np.full(len(names), -np.inf, np.float32)
    high = np.full(len(names), np.inf, np.float32)
    if body.lidar is not None:
        beams = [column for column, name in enumerate(names) if name.startswith("scan_")]
        low[beams], high[beams] = body.lidar.range_min, body.lidar.range_max
    return spaces.Box(low, high, dtype=np.float32)


class ActionScale:
    """The actions' bounds, and how actions in [-1, 1], if they are normalised, become the robot's."""

    def __init__(self, simulation: Simulation, *, normalise: bool) -> None:
        self.names = simulation.action_names
        low, high = action_bounds(simulation.body, simulation.action_names)
        self._normalise = normalise
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        if normalise:
            self.space = spaces.Box(-1.0, 1.0, (len(low),), np.float32)
        else:
            self.space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    def to_robot(self, actions: Any, running: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return actions, shape (n, a), in the robot's units, in single precision; of those that do not run any do.

        What lies outside of the bounds is passed on: the limits of the cerebellum are the robot's own.
        """
        values = np.asarray(actions)
        shape = (len(running), len(self.names))
        if values.shape != shape or values.dtype.kind not in "fiu":
            raise ActionError(
                f"The action has shape {values.shape} and type {values.dtype}; it needs {shape} numbers: "
                f"{', '.join(self.names)} of each of {shape[0]} simulation(s)."
            )
        with np.errstate(over="ignore"):  # what single precision does not hold is not finite in it
            values = values.astype(np.float32)
            if self._normalise:
                values = (self._middle + self._half * values.astype(np.float64)).astype(np.float32)
        if not np.isfinite(values).all():
            bad = np.argwhere(~np.isfinite(values) & running[:, None])
            if len(bad):
                sim, column = bad[0]
                raise ActionError(
                    f"The action {self.names[column]!r} of environment {sim} is {np.asarray(actions)[sim, column]}; "
                    "actions must be finite numbers in single precision."
                )
            values = np.where(running[:, None], values, np.float32(0.0))
        return values.astype(np.float64)


def action_bounds(body: Body, names: tuple[str, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest of each action, shapes (a,).

    A base: plus and minus its largest speeds. An arm: the range of each joint; or, for tool poses, a cube around the
    base that holds all that the arm could reach, and the quaternion's -1 to 1.
    """
    limits = body.limits
    if names == limits.names or body.arm is None:
        low, high = limits.bounds
        return np.asarray(low), np.asarray(high)
    chain = body.arm.chain
    reach, dof = chain.reach, chain.dof
    low, high = limits.bounds
    lower, upper = low[dof:], high[dof:]
    return np.array([*[-reach] * 3, *[-1.0] * 4, *lower]), np.array([*[reach] * 3, *[1.0] * 4, *upper])
