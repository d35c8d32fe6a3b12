"""The only observe-think-act-record loop: n episodes side by side, each as if it were alone."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.timing import TimingStatistics, TimingSummary
from bhd_lerobot.data import features as keys
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.robots.simulation import TurtleBot3Simulation
from bhd_lerobot.tasks.task import Event, Outcome, Task, Truth

# The brain's random numbers must not be the sensors': two streams of one episode's seed.
_BRAIN_STREAM = 2


@dataclass(frozen=True)
class EpisodeSpec:
    """An episode to be run.

    Attributes:
        index: its number in the run; results come back in this order.
        seed: decides everything that is random in it.
    """

    index: int
    seed: int


@dataclass(frozen=True)
class Episode:
    """An episode that was run.

    Attributes:
        spec: what was asked for.
        arena: where it was.
        initial_state: the simulator's complete state at its start, shape (nstate,).
        columns: the dataset's columns by key, each of shape (frames, ...), images left out.
        outcome: how it ended.
        timing: how punctual its control ticks were.
        writer: what was given for the episode's images at its start, or None.
    """

    spec: EpisodeSpec
    arena: Arena
    initial_state: NDArray[np.float64]
    columns: dict[str, NDArray]
    outcome: Outcome
    timing: TimingSummary
    writer: Any

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.columns[keys.ACTION])


class EpisodeLoop:
    """Runs episodes on n simulations. A simulation that is done with one takes the next.

    What the brain sees and what it asks for are rounded to single precision first, because that is what is recorded: a
    recorded action, applied again, is exactly the action that was applied.

    Args:
        simulation: the robots.
        task: what is to be achieved.
        brain: what drives them.
        open_images: called at the start of every episode of a robot with cameras; returns where its images go.
    """

    def __init__(
        self,
        simulation: TurtleBot3Simulation,
        task: Task,
        brain: Brain,
        open_images: Callable[[], Any] | None = None,
    ) -> None:
        self.simulation, self.task, self.brain = simulation, task, brain
        self._open_images = open_images
        self._frames = round(task.duration_s * simulation.rates.fps)
        self._columns: dict[str, NDArray] = {}
        self._length = np.zeros(simulation.n, np.int64)
        self.frames = 0
        brain.bind(simulation.observation_names, simulation.action_names, simulation.rates.fps)

    def run(self, specs: Sequence[EpisodeSpec], stop: Callable[[], bool] = lambda: False) -> Iterator[Episode]:
        """Run episodes and yield them in their order, each as soon as it and all before it are done.

        Args:
            specs: the episodes.
            stop: asked between frames; when it says yes, the episodes that run are dropped and the loop ends.
        """
        waiting = list(reversed(specs))
        done: dict[int, Episode] = {}
        order = [spec.index for spec in specs]
        n = self.simulation.n
        self._specs: list[EpisodeSpec | None] = [None] * n
        self._arenas: list[Arena | None] = [None] * n
        self._initial: list[NDArray[np.float64] | None] = [None] * n
        self._sinks: list[Any] = [None] * n
        self._pending: list[list[futures.Future[NDArray[np.uint8]]]] = [[] for _ in range(n)]
        self.simulation.stop(np.arange(n))
        self._start(np.arange(n), waiting)
        try:
            while self.simulation.running.any():
                if stop():
                    return
                finished = self._frame()
                for sim, event in finished:
                    episode = self._finish(sim, event)
                    done[episode.spec.index] = episode
                if finished:
                    ids = np.array([sim for sim, _ in finished])
                    self.simulation.stop(ids)
                    self._start(ids, waiting)
                while order and order[0] in done:
                    yield done.pop(order.pop(0))
        finally:
            for pending in self._pending:
                futures.wait(pending)
                pending.clear()
            for sink in [*self._sinks, *(episode.writer for episode in done.values())]:
                if sink is not None:
                    sink.discard()

    def _start(self, ids: NDArray[np.intp], waiting: list[EpisodeSpec]) -> None:
        """Start the next episodes in idle simulations."""
        ids = ids[: len(waiting)]
        if not len(ids):
            return
        specs = [waiting.pop() for _ in ids]
        arenas = [self.task.sample(spec.seed) for spec in specs]
        self.simulation.reset(ids, arenas, [spec.seed for spec in specs])
        self.task.begin(ids, arenas)
        brain_seeds = [int(np.random.SeedSequence([_BRAIN_STREAM, spec.seed]).generate_state(1)[0]) for spec in specs]
        self.brain.reset(ids, brain_seeds, self.simulation.n)
        states = self.simulation.snapshot(ids).state
        for sim, spec, arena, state in zip(ids, specs, arenas, states, strict=True):
            self._specs[sim], self._arenas[sim], self._initial[sim] = spec, arena, state
            self._sinks[sim] = self._open_images() if self._open_images and self.simulation.camera_names else None
        self._length[ids] = 0

    def _frame(self) -> list[tuple[int, Event]]:
        """Run one frame of all running simulations; return those that ended, and why."""
        simulation = self.simulation
        frame = simulation.observe()
        state = frame.state.astype(np.float32)
        images = self._images()
        seen = Observation(simulation.observation_names, state.astype(np.float64), images)
        action = np.asarray(self.brain.act(seen)).astype(np.float32)
        physics = simulation.physics_state
        report = simulation.act(action.astype(np.float64))
        running = np.flatnonzero(simulation.running)
        truth = Truth(simulation.world.base_pose, report.touched)
        reward, event = self.task.judge(truth, simulation.running)
        self._store(
            running,
            {
                keys.OBSERVATION_STATE: state,
                keys.ACTION: action,
                keys.APPLIED_ACTION: report.applied,
                keys.TIME: frame.time_ns / NANOSECONDS,
                keys.AGE: frame.age_ns / NANOSECONDS,
                keys.COMMAND_AGE: report.command_age_ns / NANOSECONDS,
                keys.LIMITS: report.limits,
                keys.WATCHDOG: report.watchdog,
                keys.MODE: report.mode,
                keys.REWARD: reward,
                keys.EVENT: event,
                keys.PHYSICS_STATE: physics,
            },
        )
        self._length[running] += 1
        self.frames += len(running)
        return [(int(sim), Event(int(event[sim]))) for sim in running if event[sim] != Event.NOTHING]

    def _images(self) -> dict[str, NDArray[np.uint8]]:
        """Order the images of the running simulations; return them if the brain looks at them.

        A brain that does not look at images does not wait for them: they are made while the frame goes on.
        """
        simulation = self.simulation
        images: dict[str, NDArray[np.uint8]] = {}
        for camera in simulation.camera_names:
            key = f"{keys.OBSERVATION_IMAGES}.{camera}"
            for sim in np.flatnonzero(simulation.running).tolist():
                sink = self._sinks[sim]
                deliver = None if sink is None else partial(sink.add_image, key)
                self._pending[sim].append(simulation.render_later(sim, camera, deliver))
            if self.brain.uses_images:
                height, width = simulation.config.camera_height, simulation.config.camera_width
                images[camera] = np.zeros((simulation.n, height, width, 3), np.uint8)
                for sim in np.flatnonzero(simulation.running):
                    images[camera][sim] = self._pending[sim][-1].result()
        # What went wrong in the making of an image ends the run now, not at the end of the episode.
        for waiting in self._pending:
            while waiting and waiting[0].done():
                waiting.pop(0).result()
        return images

    def _wait_for_images(self, sim: int) -> None:
        while self._pending[sim]:
            self._pending[sim].pop(0).result()

    def _store(self, running: NDArray[np.intp], values: Mapping[str, NDArray]) -> None:
        """Write one frame of the running simulations into their columns."""
        if not self._columns:
            for key, value in values.items():
                dtype = keys.SCALARS[key][0] if key in keys.SCALARS else "float32"
                dtype = "float64" if key == keys.PHYSICS_STATE else dtype
                self._columns[key] = np.zeros((self.simulation.n, self._frames, *value.shape[1:]), dtype)
        rows = self._length[running]
        for key, value in values.items():
            self._columns[key][running, rows] = value[running]

    def _finish(self, sim: int, event: Event) -> Episode:
        spec, arena, initial = self._specs[sim], self._arenas[sim], self._initial[sim]
        if spec is None or arena is None or initial is None:
            raise AssertionError(f"Simulation {sim} ended an episode that it never started.")
        self._wait_for_images(sim)
        length = int(self._length[sim])
        columns = {key: column[sim, :length].copy() for key, column in self._columns.items()}
        outcome = self.task.outcome(sim, event)
        last = np.arange(length) == length - 1
        columns[keys.DONE] = last
        columns[keys.SUCCESS] = last & outcome.success
        # A simulated clock is never late.
        columns[keys.LATENESS] = np.zeros(length, np.float32)
        columns[keys.OVERRUNS] = np.zeros(length, np.int64)
        rates = self.simulation.rates
        timing = TimingStatistics(NANOSECONDS // rates.control_hz)
        timing.add_punctual(length * rates.ticks_per_frame)
        sink, self._sinks[sim] = self._sinks[sim], None
        return Episode(spec, arena, initial, columns, outcome, timing.summary(), sink)
