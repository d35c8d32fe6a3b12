"""The only observe-think-act-record loop: n episodes side by side, each as if it were alone."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, CommandResult
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.timing import TimingStatistics, TimingSummary
from bhd_lerobot.data import features as keys
from bhd_lerobot.policies.brain import Brain, Goals, Observation
from bhd_lerobot.robots.simulation import FrameReport, Simulation
from bhd_lerobot.tasks.task import Event, Outcome, Task

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
        scene: where it was: an `Arena` or a `TableScene`.
        instruction: what was asked for: what the brain was told to do, or what the task asks for.
        initial_state: the simulator's complete state at its start, shape (nstate,).
        columns: the dataset's columns by key, each of shape (frames, ...), images left out.
        outcome: how it ended.
        timing: how punctual its control ticks were.
        writer: what was given for the episode's images at its start, or None.
        commands: the goals that the brain gave, each with the frame in which it gave it; None if it gave setpoints.
        results: how goals ended, each with the frame in which it did.
        plan: the brain's plan, as plain values, if it has one.
    """

    spec: EpisodeSpec
    scene: Any
    instruction: str
    initial_state: NDArray[np.float64]
    columns: dict[str, NDArray]
    outcome: Outcome
    timing: TimingSummary
    writer: Any
    commands: list[tuple[int, BrainCommand]] | None = None
    results: list[tuple[int, CommandResult]] = field(default_factory=list)
    plan: dict[str, Any] = field(default_factory=dict)

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
    """

    def __init__(
        self,
        simulation: Simulation,
        task: Task,
        brain: Brain,
    ) -> None:
        self.simulation, self.task, self.brain = simulation, task, brain
        self._open_images: Callable[[], Any] | None = None
        self._frames = max(1, round(task.duration_s * simulation.rates.fps))
        self._columns: dict[str, NDArray] = {}
        self._length = np.zeros(simulation.n, np.int64)
        self.frames = 0
        self._gives_goals = False
        self._truth: Any = None
        self._results: Mapping[int, Sequence[CommandResult]] = {}
        environment = task.environment_names
        brain.bind(simulation.observation_names, simulation.action_names, simulation.rates.fps, environment)

    def run(
        self,
        specs: Sequence[EpisodeSpec],
        stop: Callable[[], bool] = lambda: False,
        open_images: Callable[[], Any] | None = None,
    ) -> Iterator[Episode]:
        """Run episodes and yield them in their order, each as soon as it and all before it are done.

        Args:
            specs: the episodes.
            stop: asked between frames; when it says yes, the episodes that run are dropped and the loop ends.
            open_images: called at the start of every episode of a robot with cameras; returns where its images go.
        """
        self._open_images = open_images
        waiting = list(reversed(specs))
        done: dict[int, Episode] = {}
        order = [spec.index for spec in specs]
        n = self.simulation.n
        self._specs: list[EpisodeSpec | None] = [None] * n
        self._scenes: list[Any] = [None] * n
        self._commands: list[list[tuple[int, BrainCommand]]] = [[] for _ in range(n)]
        self._ends: list[list[tuple[int, CommandResult]]] = [[] for _ in range(n)]
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
        scenes = [self.task.sample(spec.seed) for spec in specs]
        self.simulation.reset(ids, scenes, [spec.seed for spec in specs])
        self.task.begin(ids, scenes)
        brain_seeds = [int(np.random.SeedSequence([_BRAIN_STREAM, spec.seed]).generate_state(1)[0]) for spec in specs]
        instructions = [self.task.instruction(scene) for scene in scenes]
        self.brain.reset(ids, brain_seeds, self.simulation.n, instructions)
        states = self.simulation.snapshot(ids).state
        self._results = {sim: results for sim, results in self._results.items() if sim not in ids}
        for sim, spec, scene, state in zip(ids, specs, scenes, states, strict=True):
            self._specs[sim], self._scenes[sim], self._initial[sim] = spec, scene, state
            self._commands[sim], self._ends[sim] = [], []
            self._sinks[sim] = self._open_images() if self._open_images and self.simulation.camera_names else None
        self._length[ids] = 0
        self._truth = None

    def _frame(self) -> list[tuple[int, Event]]:
        """Run one frame of all running simulations; return those that ended, and why."""
        simulation, task, brain = self.simulation, self.task, self.brain
        frame = simulation.observe()
        state = frame.state.astype(np.float32)
        images = self._images()
        values: dict[str, NDArray] = {}
        environment = None
        if task.environment_names:
            # What is true at the end of a frame is so at the beginning of the next, unless an episode began in between.
            truth = simulation.truth() if self._truth is None else self._truth
            told = task.environment_state(truth).astype(np.float32)
            environment, values[keys.ENVIRONMENT_STATE] = told.astype(np.float64), told
        seen = Observation(
            simulation.observation_names,
            state.astype(np.float64),
            images,
            environment,
            self._results,
            simulation.running,
        )
        decision = brain.act(seen)
        physics = simulation.physics_state
        if isinstance(decision, Goals):
            report = simulation.pursue(decision.commands)
            action = report.applied.astype(np.float32)
        else:
            action = np.asarray(decision).astype(np.float32)
            report = simulation.act(action.astype(np.float64))
        self._log(decision, report)
        running = np.flatnonzero(simulation.running)
        self._truth = simulation.truth()
        reward, event = task.judge(self._truth, simulation.running)
        if brain.has_plan:
            values[keys.SUBTASK] = np.array(brain.subtasks(), object)
        values |= {
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
        }
        self._store(running, values)
        self._length[running] += 1
        self.frames += len(running)
        return [(int(sim), Event(int(event[sim]))) for sim in running if event[sim] != Event.NOTHING]

    def _log(self, decision: Any, report: FrameReport) -> None:
        """Remember goals and how they ended, for the episode's metadata and for the brain."""
        self._gives_goals = isinstance(decision, Goals)
        if isinstance(decision, Goals):
            for sim, commands in decision.commands.items():
                self._commands[sim] += [(int(self._length[sim]), command) for command in commands]
        for sim, results in report.results.items():
            self._ends[sim] += [(int(self._length[sim]), result) for result in results]
        self._results = report.results

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
                dtype = {keys.PHYSICS_STATE: "float64", keys.SUBTASK: "object"}.get(key, dtype)
                self._columns[key] = np.zeros((self.simulation.n, self._frames, *value.shape[1:]), dtype)
        rows = self._length[running]
        for key, value in values.items():
            self._columns[key][running, rows] = value[running]

    def _finish(self, sim: int, event: Event) -> Episode:
        spec, scene, initial = self._specs[sim], self._scenes[sim], self._initial[sim]
        if spec is None or initial is None:
            raise AssertionError(f"Simulation {sim} ended an episode that it never started.")
        self._wait_for_images(sim)
        length = int(self._length[sim])
        columns = {key: column[sim, :length].copy() for key, column in self._columns.items()}
        outcome = self.task.outcome(sim, event)
        plan = self.brain.plan(sim) if self.brain.has_plan else {}
        last = np.arange(length) == length - 1
        columns[keys.DONE] = last
        columns[keys.SUCCESS] = last & outcome.success
        # A simulated clock is never late.
        columns |= {key: np.zeros(length, keys.SCALARS[key][0]) for key in keys.PUNCTUALITY}
        rates = self.simulation.rates
        timing = TimingStatistics(NANOSECONDS // rates.control_hz)
        timing.add_punctual(length * rates.ticks_per_frame)
        sink, self._sinks[sim] = self._sinks[sim], None
        return Episode(
            spec=spec,
            scene=scene,
            instruction=plan.get("instruction") or self.task.instruction(scene),
            initial_state=initial,
            columns=columns,
            outcome=outcome,
            timing=timing.summary(age=columns[keys.AGE], late=columns[keys.LATE]),
            writer=sink,
            commands=self._commands[sim] if self._gives_goals else None,
            results=self._ends[sim],
            plan=plan,
        )
