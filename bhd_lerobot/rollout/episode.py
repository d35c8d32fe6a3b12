"""The observe-act-record loop: n episodes side by side, each as if it were alone."""

import contextlib
import itertools
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, Chunk, Command, CommandResult, Goals
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import BrainStoppedError, RealtimeError
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures, is_privileged
from bhd_lerobot.realtime.timing import TimingStatistics, TimingSummary
from bhd_lerobot.robots.host.host import describe
from bhd_lerobot.robots.host.robots import FrameReport, Robots
from bhd_lerobot.rollout.drivers import DriverLog, flagged
from bhd_lerobot.rollout.images import EpisodeImages, Observer
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.tolerance import FrameTiming, TimingTolerance, late_frames
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.faults import add_faults
from bhd_lerobot.tasks.task import Event, Task, outcomes_of

# The brain's random numbers must not be the sensors': two streams of one episode's seed.
_BRAIN_STREAM = 2
_FIRST_FRAMES = 4096  # that there is room for at once: an episode may last much longer than it does


def track_of(robots: Robots, columns: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return where a robot was in the frames of an episode, see `Robots.track`, shape (frames, 7)."""
    return robots.track(columns[keys.OBSERVATION_STATE if robots.world is None else keys.PHYSICS_STATE])


class Status(Protocol):
    """What shows a person the state of episodes."""

    def begin(self, take: int) -> None:
        """An episode begins: its number."""

    def frame(self, number: int) -> None:
        """A frame is over, of this number on the grid of time."""

    def end(self, take: int, outcome: str) -> None:
        """An episode has ended."""


class EpisodeLoop:
    """Runs episodes on n simulations. A simulation that is done with one takes the next.

    Observations and setpoints are rounded to single precision first, because that is what is recorded: a
    recorded action, applied again, is exactly the action that was applied.

    Attributes:
        before_start: called before an episode starts, with its specification: a person may have to set up its scene.
            Returns whether the one before is discarded, and is to be run again.
        status: what shows a person the state of episodes on the wall clock; None if nothing does.
        observer: receives every frame of every simulation, and every image; None if there is none.
        emergency_stop: whether an emergency stop has ended the run: no episode is started after one.
        fault: whether a real robot's fault has, or a brain that has stopped.
        problem: why the brain has stopped, as text; empty if it has not.
        marks: takes the marks of a person for the running episodes.
        act_times: how long each call of the brain's `act` took [s].
    """

    observer: Observer | None = None
    before_start: Callable[[EpisodeSpec], bool | None] | None = None
    status: Status | None = None

    def __init__(
        self,
        robots: Robots,
        task: Task,
        brain: Brain,
        tolerance: TimingTolerance | None = None,
    ) -> None:
        self.robots, self.task, self.brain = robots, task, brain
        self.tolerance = tolerance or TimingTolerance()
        self.emergency_stop = self.fault = False
        self.problem = ""
        self.marks = Marks(robots.n, outcomes_of(task.name))
        self._last_frame = -1  # number of the last frame on the wall clock
        self._last_spec: EpisodeSpec | None = None  # of the episode that ended last
        self._mode: NDArray[np.int8] = np.zeros(robots.n, np.int8)
        self._order: list[int] = []  # numbers of the episodes in the order in which they are yielded
        self._open_images: Callable[[], Any] | None = None
        self._is_stopped: Callable[[], bool] = lambda: False
        self._columns: dict[str, NDArray] = {}
        self._length = np.zeros(robots.n, np.int64)
        self.frames = 0
        self.act_times: list[float] = []
        self._gives_goals = False
        self._drivers = DriverLog(brain, robots.n)
        self._truth: Any = None
        self._results: Mapping[int, Sequence[CommandResult]] = {}
        environment = task.environment_names
        brain.bind(
            RobotFeatures(
                robots.observation_names,
                robots.action_names,
                robots.rates.fps,
                environment,
                robots.body,
                robots.camera_shapes,
                robots.config.type,
                describe(robots.config),
            )
        )

    def run(
        self,
        specs: Sequence[EpisodeSpec],
        stop: Callable[[], bool] = lambda: False,
        open_images: Callable[[], Any] | None = None,
    ) -> Generator[Episode]:
        """Run episodes and yield them in their order, each as soon as it and all before it are done.

        Args:
            specs: the episodes.
            stop: called between frames; when it returns true, the running episodes are dropped and the loop ends.
            open_images: called at the start of every episode of a robot with cameras; returns where its images go.
        """
        self._open_images, self._is_stopped = open_images, stop
        waiting = list(reversed(specs))
        done: dict[int, Episode] = {}
        self._order = [spec.index for spec in specs]
        n = self.robots.n
        self._specs: list[EpisodeSpec | None] = [None] * n
        self._scenes: list[Any] = [None] * n
        self._commands: list[list[tuple[int, BrainCommand]]] = [[] for _ in range(n)]
        self._ends: list[list[tuple[int, CommandResult]]] = [[] for _ in range(n)]
        self._streamed: list[list[int]] = [[] for _ in range(n)]
        self._initial: list[NDArray[np.float64] | None] = [None] * n
        self._images = EpisodeImages(self.robots)
        self.robots.stop(np.arange(n))
        try:
            self._start(np.arange(n), waiting)
            while self.robots.running.any():
                if stop():
                    return
                finished = self._frame()
                # Also a take that ended by itself before the key was seen: it was not saved yet.
                ended = [(sim, event) for sim, event in finished if sim or event in (Event.ESTOP, Event.FAULT)]
                if self.marks.take_again() and not ended:
                    self._take_again(waiting)
                    continue
                for sim, event in finished:
                    episode = self._end(sim, event)
                    done[episode.spec.index] = episode
                if not finished:
                    continue
                ids = np.array([sim for sim, _ in finished])
                self.robots.stop(ids)
                # Before others start: on the wall clock they would begin while these are still being saved.
                yield from self._ready(done)
                self._start(ids, waiting)
        except RealtimeError as error:
            if self.robots.world is not None:
                raise
            # A real robot's fault where no frame can say it: its process has ended, or no episode runs.
            self.fault, self.problem = True, self.problem or str(error).removesuffix(".")
            self._cut_off(done)
            yield from self._ready(done)
        finally:
            if self.robots.clock is not None:  # it does not go on while the dataset is finished
                with contextlib.suppress(RealtimeError):
                    self.robots.stop(np.flatnonzero(self.robots.running))
            self._images.discard()
            for episode in done.values():
                if episode.writer is not None:
                    episode.writer.discard()

    def _ready(self, done: dict[int, Episode]) -> Iterator[Episode]:
        """Yield the episodes that are done, in their order, up to the first that is not."""
        while self._order and self._order[0] in done:
            yield done.pop(self._order.pop(0))

    def _cut_off(self, done: dict[int, Episode]) -> None:
        """End the episode of a robot that gives no frames any more: what was recorded of it is kept."""
        if self.robots.running[0] and self._length[0]:
            self._columns[keys.EVENT][0, self._length[0] - 1] = Event.FAULT
            episode = self._end(0, Event.FAULT)
            done[episode.spec.index] = episode

    def _take_again(self, waiting: list[EpisodeSpec]) -> None:
        """Discard the running take of the first robot, and start it again."""
        first, spec = np.zeros(1, np.intp), self._specs[0]
        if spec is None or not self.robots.running[0]:
            return
        self.robots.stop(first)
        self._images.drop(0)
        waiting.append(spec)
        self._start(first, waiting)

    def _start(self, ids: NDArray[np.intp], waiting: list[EpisodeSpec]) -> None:
        """Start the next episodes in idle simulations."""
        ids = ids[: len(waiting)]
        if not len(ids):
            return
        asks = self.before_start is not None and not (self.emergency_stop or self.fault)
        if asks and self.before_start(waiting[-1]) and self._last_spec is not None:  # type: ignore[misc]
            waiting.append(self._last_spec)
            self._order.insert(0, self._last_spec.index)
        # A person decides when the robot moves again; the stop may also have come between two episodes.
        self.emergency_stop |= self.robots.estop_pressed
        if self.emergency_stop or self.fault or self._is_stopped():
            waiting.clear()
            return
        specs = [waiting.pop() for _ in ids]
        self._length[ids] = 0
        scenes = [self.task.sample(spec.seed) for spec in specs]
        states = self.robots.reset(ids, scenes, [spec.seed for spec in specs])
        self.task.begin(ids, scenes)
        brain_seeds = [int(np.random.SeedSequence([_BRAIN_STREAM, spec.seed]).generate_state(1)[0]) for spec in specs]
        instructions = [self.task.instruction(scene) for scene in scenes]
        self.brain.reset(ids, brain_seeds, self.robots.n, instructions)
        self._results = {sim: results for sim, results in self._results.items() if sim not in ids}
        for sim, spec, scene, state in zip(ids, specs, scenes, states, strict=True):
            self._specs[sim], self._scenes[sim], self._initial[sim] = spec, scene, state
            self._commands[sim], self._ends[sim], self._streamed[sim] = [], [], []
            self._images.sinks[sim] = self._open_images() if self._open_images and self.robots.camera_shapes else None
        self._last_frame = -1
        self._drivers.start(ids)
        self.marks.begin(ids)
        if self.status is not None:
            self.status.begin(specs[0].index)
        self._truth = None

    def _frame(self) -> list[tuple[int, Event]]:
        """Run one frame of all running simulations; return those that ended, and why."""
        robots, task, brain = self.robots, self.task, self.brain
        frame = robots.observe()
        state = frame.state.astype(np.float32)
        images = self._images.order_all(self.observer, np.broadcast_to(brain.needs_images(self._results), robots.n))
        values: dict[str, NDArray] = {}
        environment = None
        if task.environment_names:
            # What is true at the end of a frame is so at the beginning of the next, unless an episode began in between.
            truth = robots.truth() if self._truth is None else self._truth
            values[keys.ENVIRONMENT_STATE] = task.environment_state(truth).astype(np.float32)
            if is_privileged(brain, task.environment_names):
                environment = values[keys.ENVIRONMENT_STATE].astype(np.float64)
        seen = Observation(
            robots.observation_names,
            state.astype(np.float64),
            images,
            environment,
            self._results,
            robots.running,
        )
        started = time.perf_counter()
        try:
            command = in_single_precision(brain.act(seen))
        except BrainStoppedError as error:
            command, self.problem = None, str(error)
        self.act_times.append(time.perf_counter() - started)
        # On the lockstep clock time stands still during inference.
        inference_time = np.full(robots.n, 0.0 if robots.clock is None else self.act_times[-1])
        report = robots.step(command)
        self._log(command, report)
        if brain.has_plan:
            values[keys.SUBTASK] = np.array(brain.subtasks(), object)
        values |= {
            keys.OBSERVATION_STATE: state,
            keys.ACTION: report.requested.astype(np.float32),
            keys.TIME: frame.time_ns / NANOSECONDS,
            keys.AGE: frame.age_ns / NANOSECONDS,
            keys.INFERENCE_TIME: inference_time,
            **frame.columns,
        }
        if (advised := brain.advice()) is not None:
            done = np.where(np.isnan(advised), report.requested, advised)
            values[keys.EXPERT_ACTION] = done.astype(np.float32)
        finished: list[tuple[int, Event]] = []
        for number, frame_report in enumerate((*report.missed, report)):
            if number:  # of the first the brain saw the beginning; the others went by during inference
                values |= self._seen_values(frame_report)
            finished = self._end_frame(frame_report, values, is_missed=frame_report is not report)
            if finished:
                break  # what a robot did after its episode's end is not part of it
        return finished

    def _end_frame(
        self, report: FrameReport, values: dict[str, NDArray], *, is_missed: bool
    ) -> list[tuple[int, Event]]:
        """Judge and store a frame; return the episodes that ended with it."""
        robots = self.robots
        running = np.flatnonzero(robots.running)
        if robots.clock is not None:
            # Time goes on in frames that were left out.
            self.task.frame[running] += max(0, report.number - self._last_frame - 1)
            if self.status is not None:
                self.status.frame(report.number)
        self._last_frame, self._mode = report.number, report.mode
        self._truth = report.truth()
        reward, event = self.task.judge(self._truth, robots.running)
        event = add_faults(event, report.mode, robots.running)
        event, driven = self.marks.frame(event, robots.running)
        if self.problem:
            event = np.where(robots.running & (event == Event.NOTHING), int(Event.FAULT), event)
        taken = self._drivers.frame(running, self._length, is_missed=is_missed)
        values |= {
            keys.ACTION: report.requested.astype(np.float32),
            keys.APPLIED_ACTION: report.applied,
            keys.LIMITS: report.limits,
            keys.WATCHDOG: report.watchdog,
            keys.MODE: report.mode,
            **report.columns,
            keys.REWARD: reward,
            keys.EVENT: flagged(event, taken | driven),
        }
        self._store(running, values)
        if self.observer is not None:
            for sim in running.tolist():
                self.observer(sim, {key: value[sim] for key, value in values.items()})
        self._length[running] += 1
        self.frames += len(running)
        return [(int(sim), Event(int(event[sim]))) for sim in running if event[sim] != Event.NOTHING]

    def _seen_values(self, report: FrameReport) -> dict[str, NDArray]:
        """Return what was observed at the start of a frame that went by during inference."""
        seen = report.seen
        if seen is None:
            raise AssertionError("Frames go by during inference on the wall clock only, where each is observed.")
        values: dict[str, NDArray] = {
            keys.OBSERVATION_STATE: seen.state.astype(np.float32),
            keys.TIME: seen.time_ns / NANOSECONDS,
            keys.AGE: seen.age_ns / NANOSECONDS,
            **seen.columns,
        }
        if self.task.environment_names:
            values[keys.ENVIRONMENT_STATE] = self.task.environment_state(self._truth).astype(np.float32)
        # What is shown is the end of the frame before: its beginning. The brain was not asked, so it does not look.
        self._images.order_all(self.observer, np.zeros(self.robots.n, np.bool_))
        return values

    def _log(self, command: Command, report: FrameReport) -> None:
        """Remember goals and how they ended, for the episode's metadata and for the brain."""
        self._drivers.decided()
        last = self._length + len(report.missed)  # the frame that it is now, of each episode
        if isinstance(command, Goals):
            self._gives_goals = True
            for sim, goals in command.commands.items():
                self._commands[sim] += [(int(last[sim]), goal) for goal in goals]
            for sim in command.streamed.tolist():
                self._streamed[sim] += range(int(self._length[sim]), int(last[sim]) + 1)
        for sim, results in report.results.items():
            self._ends[sim] += [(int(last[sim]), result) for result in results]
        self._results = report.results

    def _store(self, running: NDArray[np.intp], values: Mapping[str, NDArray]) -> None:
        """Write one frame of the running simulations into their columns."""
        if not self._columns:
            room = min(self.task.max_frames, _FIRST_FRAMES)
            for key, value in values.items():
                dtype = keys.SCALARS[key][0] if key in keys.SCALARS else "float32"
                dtype = {keys.PHYSICS_STATE: "float64", keys.SUBTASK: "object"}.get(key, dtype)
                self._columns[key] = np.zeros((self.robots.n, room, *value.shape[1:]), dtype)
        rows = self._length[running]
        if rows.max(initial=0) == self._columns[keys.ACTION].shape[1]:
            self._columns = {
                key: np.concatenate([column, np.zeros_like(column)], axis=1) for key, column in self._columns.items()
            }
        for key, value in values.items():
            self._columns[key][running, rows] = value[running]

    def _timing(self, sim: int, columns: dict[str, NDArray]) -> TimingSummary:
        """Return how punctual an episode was, and add the columns that follow from that."""
        robots, length = self.robots, len(columns[keys.ACTION])
        rates = robots.rates
        clock = robots.clock
        if clock is None:
            columns |= {key: np.zeros(length, keys.SCALARS[key][0]) for key in keys.PUNCTUALITY}
            timing = TimingStatistics(NANOSECONDS // rates.control_hz)
            timing.add_punctual(length * rates.ticks_per_frame)
            return timing.summary(age=columns[keys.AGE], late=columns[keys.LATE])
        with contextlib.suppress(RealtimeError):  # its process may have ended, which the next call says
            robots.stop(np.array([sim]))
        measured = FrameTiming(*(columns[key] for key in (keys.TIME, keys.AGE, keys.LATENESS, keys.SKIPPED)))
        columns[keys.LATE] = late_frames(measured, self.tolerance, rates, clock.sensor_period_s)
        return clock.statistics().summary(
            clock="realtime",
            age=columns[keys.AGE],
            inference_time=columns[keys.INFERENCE_TIME],
            late=columns[keys.LATE],
            drops=self._last_frame + 1 - length,
            tolerated=self.tolerance.limits(rates, clock.sensor_period_s),
        )

    def _end(self, sim: int, event: Event) -> Episode:
        """End an episode, and note whether it ends the run."""
        episode = self._finish(sim, event)
        if self.robots.n == 1:
            self.marks.close("no take runs")
        self.emergency_stop |= event == Event.ESTOP
        # A person finds out why a real robot stopped before it moves again.
        is_faulty = event == Event.FAULT or self._mode[sim] == Mode.FAULT
        self.fault |= is_faulty and (self.robots.world is None or bool(self.problem))
        self._last_spec = episode.spec
        if self.status is not None:
            self.status.end(episode.spec.index, episode.outcome.event.cause)
        return episode

    def _finish(self, sim: int, event: Event) -> Episode:
        spec, scene, initial = self._specs[sim], self._scenes[sim], self._initial[sim]
        if spec is None or initial is None:
            raise AssertionError(f"Simulation {sim} ended an episode that it never started.")
        writer = self._images.finish(sim)
        length = int(self._length[sim])
        columns = {key: column[sim, :length].copy() for key, column in self._columns.items()}
        outcome = self.task.outcome(sim, event)
        plan = self.brain.plan(sim) if self.brain.has_plan else {}
        last = np.arange(length) == length - 1
        columns[keys.DONE] = last
        columns[keys.SUCCESS] = last & outcome.success
        timing = self._timing(sim, columns)
        return Episode(
            spec=spec,
            scene=scene,
            instruction=plan.get("instruction") or self.task.instruction(scene),
            initial_state=initial,
            columns=columns,
            outcome=outcome,
            timing=timing,
            writer=writer,
            commands=self._commands[sim] if self._gives_goals else None,
            results=self._ends[sim],
            goal_frames=_spans_without(self._streamed[sim], length) if self._streamed[sim] else None,
            plan=plan,
            realtime=None if self.robots.clock is None else self.robots.clock.grants,
            interventions=self._drivers.interventions(sim),
        )


def _spans_without(frames: Sequence[int], length: int) -> list[tuple[int, int]]:
    """Return the spans, first and end, of what is left of an episode without some frames."""
    ends = [-1, *frames, length]
    return [(first + 1, end) for first, end in itertools.pairwise(ends) if first + 1 < end]


def in_single_precision(command: Command) -> Command:
    """Return a command with its setpoints rounded to single precision, as float64; goals are left as they are."""
    match command:
        case None | Goals(_, None):
            return command
        case Goals(_, setpoints):
            assert setpoints is not None
            return replace(command, setpoints=_rounded(setpoints))
        case Chunk():
            return replace(command, actions=_rounded(command.actions))
        case _:
            return _rounded(command)


def _rounded(actions: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(actions).astype(np.float32).astype(np.float64)
