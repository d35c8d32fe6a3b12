"""A simulation whose world runs in the plant's process, as the cerebellum's process sees it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.base.controller import BaseController
from bhd_lerobot.realtime.plant_link import PlantLink, PlantShape, RemotePlant
from bhd_lerobot.robots.host.simulation import Simulation

_ODOMETRY = ("x.pos", "y.pos", "theta.pos")


def plant_shape(simulation: Simulation) -> PlantShape:
    """Return the sizes of what the plant of a robot publishes; the ring holds one second."""
    return PlantShape(
        joints=simulation.cerebellum.controller.joints,
        positions=simulation.world.qpos.shape[1],
        velocities=simulation.world.qvel.shape[1],
        features=len(simulation.observation_names),
        touches=len(simulation.touches),
        sensors=simulation.cerebellum.reading.sensors.shape[1],
        capacity=simulation.rates.control_hz,
    )


class RemoteSimulation(Simulation):
    """One robot with its cerebellum here and its world in another process.

    The own world is never stepped: it is put into what the plant publishes.
    """

    def __init__(self, own: Simulation, link: PlantLink) -> None:
        self._own = own
        super().__init__(
            own.config,
            own.cerebellum,
            world=own.world,
            action_names=own.action_names,
            observation_names=own.observation_names,
            camera_names=own.camera_names,
            bridge=own.bridge,
        )
        self.sensor_period_s = own.sensor_period_s
        self.remote = self.cerebellum.plant = RemotePlant(link)
        self._taken: Any = None
        self._touches: NDArray[np.int64] = np.zeros(len(own.touches), np.int64)  # counts taken so far
        has_odometry = set(_ODOMETRY) <= set(own.observation_names)
        first = own.observation_names.index(_ODOMETRY[0]) if has_odometry else 0
        self._odometry = slice(first, first + len(_ODOMETRY)) if has_odometry else None

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Put the own world into a scene; the plant's process does that with its own."""
        self._own.place(ids, scenes)

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode; the plant's process has put its world into the scene already."""
        state = self.remote.refresh()
        self.remote.recover()  # stops of another episode
        initial = self._own.reset(ids, scenes, seeds)
        self._touches[:] = state["touches"]
        for flag in self.touches:
            flag[:] = False
        return initial

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the robot was in recorded states, shape (frames, 7)."""
        return self._own.track(states)

    def truth(self) -> Any:
        """Return what is true in the newest state; object poses are those that the world was last put into."""
        self.advance()
        return self._own.truth()

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """What was touched since the flags were cleared last, by kind, live, each of shape (1,)."""
        return self._own.touches

    def advance(self) -> None:
        """Take the newest state of the plant, which continues by itself."""
        state = self.remote.refresh()
        if state is None or state is self._taken:
            return
        self._taken = state
        self.tick = int(state["tick"])
        self.world.qpos[:], self.world.qvel[:] = state["qpos"], state["qvel"]
        touched = state["touches"] > self._touches
        if touched.any():
            self._touches[:] = state["touches"]
            for flag, one in zip(self.touches, touched, strict=True):
                flag[:] |= one

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the plant's observation, shape (1, features), and the tick of the oldest reading, shape (1,)."""
        self.advance()
        state = self.remote.state
        observation: NDArray[np.float64] = state["observation"].copy()
        controller = self.cerebellum.controller
        if self._odometry is not None and isinstance(controller, BaseController):
            # Odometry is the cerebellum's memory: where it began is known here only.
            observation[:, self._odometry] = controller.drive.odometry_at(state["position"])
        return observation, np.array([int(state["oldest"])])

    def sensed_ns(self) -> int:
        """Return when the plant read what `sense` returned last, monotonic [ns]."""
        return int(self.remote.state["stamp_ns"])

    def close(self) -> None:
        """Free everything. May be called twice."""
        super().close()
        self._own.close()
