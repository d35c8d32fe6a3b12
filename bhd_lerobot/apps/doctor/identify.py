"""The servos of an arm: each joint is moved by three sines, and a simulation is fitted to how it follows."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.sim.world import World

_SINES = ((0.5, 0.06), (1.5, 0.025), (3.0, 0.01))  # [Hz], [rad]
_SECONDS, _RAMP_S = 8.0, 1.0
_FPS = 100  # at the most
_TO_HOME = 0.5  # [rad/s]
_STEP = 0.02  # of a parameter, for its derivative
_LATENCY_S, _MOST_LATENCY_S = 0.02, 0.2
_FRICTION = 0.05  # [N m] friction's unit

_NUMBERS = count()  # of goals, whose names differ

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """How a joint followed.

    Attributes:
        joint: its number.
        command_s: times of the commands [s].
        command: what the arm was commanded, before the servos' lead, shape (commands, joints).
        read_s: times of the readings [s].
        read: the joint's positions [rad], shape (readings,).
    """

    joint: int
    command_s: Array
    command: Array
    read_s: Array
    read: Array


@dataclass(frozen=True)
class ServoModel:
    """Stiffness [N m/rad], damping [N m s/rad], friction [N m] and latency [s] of a servo; error of the fit [rad]."""

    stiffness: float
    damping: float
    friction: float
    latency_s: float
    error_rad: float


def for_identification(config: Any) -> Any:
    """Return the configuration of an arm that is commanded joint by joint, as often as its control rate allows."""
    if not hasattr(config, "measured"):
        raise ConfigError(
            f"robot.type is {config.type!r}, whose servos are known; those of arms from a file are identified: choose "
            "arm with --robot.mjcf=FILE, or one of your own that has a file."
        )
    fps = max(fps for fps in range(1, _FPS + 1) if config.control_hz % fps == 0)
    return replace(config, fps=fps, action_space="joint")


def excite(host: Any) -> Iterator[Track]:
    """Move each joint of an arm about home, and yield how it followed.

    Raises:
        RealtimeError: the arm does not get home, or is stopped.
    """
    arm, fps = host.body.need(Arm), host.rates.fps
    names, dof = [f"{joint}.pos" for joint in arm.chain.joints], len(arm.chain.joints)
    columns = [host.observation_names.index(name) for name in names]
    times = np.arange(round(_SECONDS * fps)) / fps
    ramp = np.clip(np.minimum(times, times[-1] - times) / _RAMP_S, 0.0, 1.0)
    wave = ramp * sum(size * np.sin(2 * np.pi * hz * times) for hz, size in _SINES)
    for joint in range(dof):
        _go_home(host, arm)
        action, rows = np.array([arm.home]), []
        for offset in wave:
            action[0, joint] = arm.home[joint] + offset
            frame = host.observe()
            report = host.step(action.copy())
            for one in (*report.missed, report):
                seen = one.seen or frame
                at, age = (float(np.ravel(value)[0]) / 1e9 for value in (seen.time_ns, seen.age_ns))
                rows.append((at, at - age, seen.state[0, columns[joint]], one.applied[0, :dof]))
            _check(host)
        start, read_s, read, command = (np.array(one) for one in zip(*rows, strict=True))
        fresh = np.flatnonzero(np.diff(read_s, prepend=-np.inf) > 0)
        yield Track(joint, start[1:], command[:-1], read_s[fresh], read[fresh])


def _go_home(host: Any, arm: Arm) -> None:
    name, joints = f"home_{next(_NUMBERS)}", arm.home[: len(arm.chain.joints)]
    goal = BrainCommand(name, joint_target=joints, max_velocity=_TO_HOME, timeout_s=60.0)
    refusal = host.bridge.submit(goal)
    results = [] if refusal is None else [refusal]
    while not results:
        host.observe()
        results = host.step(None).results.get(0, [])
        _check(host)
    if not results[0].success:
        raise RealtimeError(f"The arm did not get home: {results[0].message}")


def _check(host: Any) -> None:
    if host.modes[0] in (Mode.ESTOP, Mode.FAULT):
        raise RealtimeError(f"The arm was stopped, {Mode(int(host.modes[0])).name}: {host.problem}.")


def identify(body: Body, track: Track) -> ServoModel:
    """Fit stiffness, damping, friction and latency of a joint's servo; the inertias are those of the body.

    A constant offset of the readings, as of an arm that gives way to its weight, is left out.
    """
    fitted = _Fit(body, track)
    found = least_squares(fitted.errors, np.array([1.0, 1.0, 1.0, 0.5]), fitted.slopes, bounds=(1e-3, np.inf))
    stiffness, damping, friction, latency = fitted.values(found.x)
    error = float(np.sqrt(np.mean(found.fun**2)))
    return ServoModel(float(stiffness), float(damping), float(friction), float(latency), error)


class _Fit:
    """Simulations of a joint that follows, one for the parameters and one for a step of each of them."""

    def __init__(self, body: Body, track: Track) -> None:
        arm = body.need(Arm)
        self._track, self._world = track, World(body, 5)
        self._period = 1.0 / self._world.physics_hz
        self._at = self._world.joint_slice(arm.chain.joints)[0].start + track.joint
        self._nominal = arm.servo_stiffness[track.joint], arm.servo_damping[track.joint]
        spline = CubicSpline(track.command_s, track.command)
        self._start, self._end = track.command_s[0], track.command_s[-1]
        lead = np.asarray(arm.lead_s[: track.command.shape[1]])
        self._wire = lambda at: spline(at) + lead * spline(at, 1)
        self._kept: tuple[Array, Array] | None = None
        self._inside = (track.read_s > self._start + _MOST_LATENCY_S) & (track.read_s < self._end)

    def values(self, x: Array) -> Array:
        """Return the physical values of scaled parameters."""
        stiffness, damping = self._nominal
        return x * np.array([stiffness, damping, _FRICTION, _LATENCY_S])

    def errors(self, x: Array) -> Array:
        """Return by how much the simulation is off at each reading [rad]."""
        return self._all(x)[0]

    def slopes(self, x: Array) -> Array:
        """Return the derivatives of the errors, shape (readings, 4)."""
        errors = self._all(x)
        return (errors[1:] - errors[0]).T / _STEP

    def _all(self, x: Array) -> Array:
        if self._kept is None or not np.array_equal(self._kept[0], x):
            self._kept = x.copy(), self._run(np.array([x, *(x + _STEP * np.eye(4))]))
        return self._kept[1]

    def _run(self, rows: Array) -> Array:
        world, joint = self._world, self._track.joint
        values = np.array([self.values(row) for row in rows])
        gain, bias = world.model_field("actuator_gainprm"), world.model_field("actuator_biasprm")
        dof = world.joint_slice(world.body.need(Arm).chain.joints)[1]
        friction = world.model_field("dof_frictionloss")[:, dof]
        world.reset()
        gain[:, joint, 0], bias[:, joint, 1] = values[:, 0], -values[:, 0]
        bias[:, joint, 2], friction[:, joint] = -values[:, 1], values[:, 2]
        at = np.arange(self._start, self._end, self._period)
        late = np.clip(at[:, None] - values[:, 3], self._start, self._end)  # (ticks, 5)
        wire = self._wire(late)  # (ticks, 5, joints)
        seen = np.empty((len(at), len(rows)))
        joints = wire.shape[2]
        for tick, command in enumerate(wire):
            seen[tick] = world.qpos[:, self._at]
            world.ctrl[:, :joints] = command
            world.step()
        read = self._track.read_s[self._inside]
        found = np.array([np.interp(read, at, column) for column in seen.T])
        errors = found - self._track.read[self._inside]
        return errors - errors.mean(axis=1, keepdims=True)


def servo_table(body: Body, found: dict[int, ServoModel]) -> Table:
    """Return a table of identified servos, by joint, beside the body's numbers."""
    arm = body.need(Arm)
    table = Table(title="servos, in rad, s and N m: found, the body's", title_justify="left", box=SIMPLE)
    for heading in ("", "stiffness", "damping", "friction", "latency", "error"):
        table.add_column(heading, overflow="fold")
    for joint, one in found.items():
        table.add_row(
            arm.chain.joints[joint],
            f"{one.stiffness:.3g}, {arm.servo_stiffness[joint]:.3g}",
            f"{one.damping:.3g}, {arm.servo_damping[joint]:.3g}",
            f"{one.friction:.3g}",
            f"{one.latency_s:.3f}",
            f"{one.error_rad:.4f}",
        )
    return table


def servo_option(body: Body, found: dict[int, ServoModel]) -> str:
    """Return the option that simulates an arm with the servos that it has."""
    joints = body.need(Arm).chain.joints
    rows = (f"{joints[k]}: [{one.stiffness:.3g}, {one.damping:.3g}, {one.friction:.3g}]" for k, one in found.items())
    return f"--robot.servos='{{{', '.join(rows)}}}'"
