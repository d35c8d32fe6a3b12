"""n simulations of a robot with a task: the episodes of `rollout/episode.py`, stepped from outside."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import BhdError
from bhd_lerobot.registry import make_simulation, make_task
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.tasks.faults import add_faults
from bhd_lerobot.tasks.task import Event, Outcome

EVENT_NAMES = np.array([event.cause for event in Event], object)
"""Names of the events, by their numbers."""

_VIEW_WIDTH, _VIEW_HEIGHT = 320, 240


class ResetNeededError(BhdError, gymnasium.error.ResetNeeded):
    """An environment was stepped that is in no episode."""


class ClosedError(BhdError, gymnasium.error.ClosedEnvironmentError):
    """An environment was used after it had been closed."""


@dataclass(frozen=True)
class Stepped:
    """What came of a frame, each of shape (n,); zeros for simulations that did not run.

    `truncated`: whether an episode ended because the time was over, and for no other reason.
    """

    reward: NDArray[np.float64]
    event: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class SteppedEpisodes:
    """n simulations, each in an episode of its own, or idle; `frames`: longest duration of an episode."""

    def __init__(self, robot: Any, task: Any, n: int = 1, threads: int | None = None) -> None:
        self.n = n
        self.simulation = make_simulation(robot, n, threads)
        self.task = make_task(task, n, robot.fps, self.simulation.body)
        self.frames = max(1, round(self.task.duration_s * robot.fps))
        self.seeds = np.zeros(n, np.int64)
        self.limits: NDArray[np.int64] = np.zeros(n, np.int64)
        self.scenes: list[Any] = [None] * n
        self._truth: Any = None
        self._eyes: Camera | None = None
        self._view: Camera | None = None
        self.simulation.stop(np.arange(n))

    @property
    def running(self) -> NDArray[np.bool_]:
        """Which simulations are in an episode, shape (n,), live."""
        return self.simulation.running

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        """Start the episodes with these seeds in these simulations."""
        scenes = [self.task.sample(seed) for seed in seeds]
        self.simulation.reset(ids, scenes, seeds)
        self.task.begin(ids, scenes)
        self.seeds[ids] = seeds
        self.limits[ids] = 0
        for sim, scene in zip(ids.tolist(), scenes, strict=True):
            self.scenes[sim] = scene
        self._truth = None

    def rest(self, ids: NDArray[np.intp]) -> None:
        """Leave simulations alone until their next `reset`."""
        self.simulation.stop(ids)

    def observe(self, ids: NDArray[np.intp] | None = None) -> dict[str, Any]:
        """Return what the robots see now; rows of others than `ids`, or all that run, mean nothing.

        Call it once a frame: noisy sensors read something else each time. `agent_pos`, shape (n, k);
        `environment_state`, shape (n, e), if reported; `pixels` by camera name, shape (n, height, width, 3).
        """
        simulation, running = self.simulation, self.simulation.running
        if ids is not None:
            simulation.running = np.zeros(self.n, np.bool_)
            simulation.running[ids] = True
        try:
            seen: dict[str, Any] = {"agent_pos": simulation.observe().state.astype(np.float32)}
            if simulation.camera_names:
                seen["pixels"] = self._images(np.flatnonzero(simulation.running))
        finally:
            simulation.running = running
        if self.task.environment_names:
            # What is true at the end of a frame is so at the beginning of the next, unless an episode began in between.
            truth = simulation.truth() if self._truth is None else self._truth
            seen["environment_state"] = self.task.environment_state(truth).astype(np.float32)
        return seen

    def step(self, actions: NDArray[np.float64]) -> Stepped:
        """Let one frame go by, with finite actions of single precision, shape (n, a).

        Simulations whose episodes ended continue running until `rest` or `reset`.
        """
        simulation = self.simulation
        report = simulation.step(actions)
        self._truth, self.limits = report.truth(), report.limits.copy()
        reward, event = self.task.judge(self._truth, simulation.running)
        event = add_faults(event, report.mode, simulation.running)
        truncated = event == Event.TIMEOUT
        if self.task.lasts:
            truncated |= event == Event.SUCCESS
        return Stepped(reward, event, (event != Event.NOTHING) & ~truncated, truncated)

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how the episode of one simulation ended."""
        return self.task.outcome(sim, event)

    def instruction(self, sim: int) -> str:
        """Return the instruction of the episode of one simulation; nothing before its first."""
        scene = self.scenes[sim]
        return "" if scene is None else self.task.instruction(scene)

    def render(self, sim: int) -> NDArray[np.uint8]:
        """Return one simulation from outside, shape (240, 320, 3)."""
        if self._view is None:
            self._view = Camera(self.simulation.world, _VIEW_WIDTH, _VIEW_HEIGHT)
        return self._view.render(sim, self.simulation.view)

    def _images(self, ids: NDArray[np.intp]) -> dict[str, NDArray[np.uint8]]:
        config = self.simulation.config
        if self._eyes is None:
            self._eyes = Camera(self.simulation.world, config.camera_width, config.camera_height)
        shape = (self.n, config.camera_height, config.camera_width, 3)
        images = {name: np.zeros(shape, np.uint8) for name in self.simulation.camera_names}
        for sim in ids.tolist():
            for name, image in images.items():
                self._eyes.render(sim, name, out=image[sim])
        return images

    def close(self) -> None:
        """Free the renderers. May be called twice."""
        for camera in (self._eyes, self._view):
            if camera is not None:
                camera.close()
        self._eyes = self._view = None
        self.simulation.close()
