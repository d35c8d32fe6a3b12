"""A robot on the wall clock: cerebellum and plant run in a process of their own."""

import itertools
import os
import time
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

from bhd_lerobot.control.commands import BrainCommand, Chunk, Command, Goals
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Watchdog
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.bridge import LiveBridge
from bhd_lerobot.realtime.frame_reader import Boundary, FrameReader
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.robots.host.checked_plant import Unconnected, plant_class
from bhd_lerobot.robots.host.frames import frame_of, report_of
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.link import LiveLink
from bhd_lerobot.robots.host.robots import Acceptance, ActionReport, Frame, FrameReport
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.host.state import problem_of

_SILENCE_S = 2.0  # so long after it was due a frame that does not come means that the loop is stuck


class LiveClock:
    """How punctual a robot on the wall clock is; see `Clock`."""

    def __init__(self, link: LiveLink, sensor_period_s: float) -> None:
        self._link = link
        self.sensor_period_s = sensor_period_s
        self.grants: list[dict[str, Any]] | None = link.grants

    def statistics(self) -> TimingStatistics:
        """Return how punctual the ticks of the present episode are; live."""
        return TimingStatistics.view(self._link.block.section("statistics"))


class LiveHost(Host):
    """One robot on the wall clock: a host whose ticks another process runs; its record is the one that is published.

    It never ticks itself. Put into what was published, it computes the truth that tasks judge by and, if it is a
    simulation, renders images. `make_live` makes a class of it and of the host of a kind of robot, none of whose
    private names it shares.

    Attributes:
        runs: what the other process runs.
        link: that process.
        bridge: how commands get to its cerebellum.

    Args:
        arguments: of that host, as are the options.
        name: name of the running robot, for `bhd-monitor`.

    Raises:
        RealtimeError: the processes could not be started, or real time is required and was refused.
    """

    runs: ClassVar[type[Host]]
    bridge: LiveBridge  # type: ignore[assignment]

    def __init__(self, *arguments: Any, name: str, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.link = LiveLink(self, self.config, name)
        self.clock = LiveClock(self.link, self.sensor_period_s)
        self.bridge = LiveBridge(self.link.block, self.cerebellum, self.rates, self.link.wait)
        self.__frame_ns = NANOSECONDS // self.rates.fps
        self.__reader: FrameReader | None = None
        self.__boundary: Any = None  # the newest boundary of a frame that was taken
        self.__shown: Any = None  # what was published last that this host shows
        self.__watchdog = Watchdog(0)  # of the last frame
        self.__origin = 0  # when the episode's first observation was taken, monotonic [ns]

    def __show(self, state: Any) -> None:
        self.bridge.show(state)
        if self.__shown is not state:
            self.__shown = state
            self.show(state)

    def __truth_at(self, end: Any, touched: NDArray[np.bool_]) -> Any:
        self.__show(end)
        for flag, one in zip(self.touches, touched, strict=True):
            flag[:] = one
        return self.runs.truth(self)

    def truth(self) -> Any:
        """Return what is true at the start of the present frame."""
        if self.__shown is None and self.__boundary is not None:
            self.__show(self.__boundary.state)
        return self.runs.truth(self)

    @property
    def notes(self) -> list[str]:
        """What the system refused the real-time process, and the remedy; what a device does not tell."""
        return [*map(escape, getattr(self.config, "notes", ()))] + [
            f"[bold]Real time: {grant['name']} was refused.[/bold] {escape(grant['detail'])} {escape(grant['remedy'])}"
            for grant in self.link.grants
            if not grant["granted"]
        ]

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode: put the robot into its scene. Its time begins with the first observation, or with `begin`.

        A real robot is driven to the start of the scene, if it is an arm; a base is put there by a person.

        Raises:
            RealtimeError: a process has ended or does not answer, or the robot does not get to the start.
        """
        link = self.link
        link.place(scenes[0], int(seeds[0]))
        goal = self.start_goal(scenes[0]) if self.world is None else None
        if goal is not None:
            self.__go_to_start(goal)
            link.place(scenes[0], int(seeds[0]))
        initial = super().reset(ids, scenes, seeds)
        self.__reader = None
        self.__boundary, self.__shown = None, None
        return initial

    def __go_to_start(self, goal: BrainCommand) -> None:
        self.bridge.restart(np.zeros(1, np.intp))
        self.link.run()
        refusal = self.bridge.submit(goal)
        results = [] if refusal is None else [refusal]
        while not results:
            self.link.wait()
            results = self.bridge.take_results()
        self.link.pause()
        if not results[0].success:
            why = problem_of(self.bridge.latest) or f"{results[0].code.name}, {results[0].message.removesuffix('.')}"
            raise RealtimeError(
                f"The robot did not get to the start of the episode: {why}. Episodes that were saved are intact."
            )

    def begin(self) -> None:
        """Let the loop run, if it does not yet.

        Raises:
            RealtimeError: a process has ended or does not answer.
        """
        if self.__reader is None:
            self.__reader = FrameReader(self.link.block.ring, self.rates.ticks_per_frame)
            self.link.block.words[[Word.RECORDER_FRAMES, Word.RECORDER_DROPS]] = 0
            self.__origin = self.link.run() - NANOSECONDS // self.rates.control_hz
            self.__take(0)

    def stop(self, ids: NDArray[np.intp]) -> None:
        """End the episode: the loop stands."""
        if len(ids):
            super().stop(ids)
            self.link.pause()

    def observe(self) -> Frame:
        """Return the observation that the present frame began with; its age is what it is now."""
        self.begin()
        self.__show(self.__boundary.state)
        return self.__frame_of(self.__boundary.state, time.monotonic_ns())

    def latest(self) -> Frame:
        """Return the newest observation, whatever frame it is in.

        Raises:
            RealtimeError: a process has ended, or is stopped.
        """
        state = self.__newest_row()
        self.__show(state)
        return self.__frame_of(state, time.monotonic_ns())

    def __newest_row(self) -> Any:
        """Return the newest state; the last state of a process that has ended, or is stopped, does not count."""
        self.link.check()
        state = self.bridge.latest
        silence = (time.monotonic_ns() - int(state["sensed_ns"])) / NANOSECONDS
        if self.__reader is not None and self.running[0] and silence > _SILENCE_S:
            raise RealtimeError(
                f"The cerebellum's process ({self.link.pid}) has published nothing for {silence:.1f} s: "
                "it is stopped, or gets no processor time. Disconnect and connect again."
            )
        return state

    def __frame_of(self, state: Any, seen_ns: int) -> Frame:
        return frame_of(self, state, seen_ns, self.__origin)

    # --- frames ------------------------------------------------------------------------------------------------------

    def send(self, command: Command, start_ns: int | None = None) -> Acceptance:
        """Send a command and return at once.

        Raises:
            RealtimeError: a process has ended, or is stopped.
        """
        self.__show(self.__newest_row())  # what a tool pose is solved from is where the arm is commanded to be
        start = self.__boundary.frame * self.__frame_ns if isinstance(command, Chunk) else None
        return super().send(command, start)

    def act(self, command: Command) -> ActionReport:
        """Send a command and return at once, with the newest command of the cerebellum as what is applied.

        Raises:
            RealtimeError: a process has ended, or is stopped.
        """
        receipt = self.send(command)
        applied = self.to_action(self.bridge.state().command)
        return ActionReport(sent=receipt.sent, refusals=receipt.refusals, mode=self.modes, applied=applied)

    def _frame(self, receipt: Acceptance, command: Command) -> FrameReport:
        """Wait for the end of the frame that it is now; frames that went by before are in `missed` of the report."""
        # Boundary k is the end of tick k F - 1, one period before k frames.
        now = time.monotonic_ns() - self.__origin
        last = max(self.__boundary.frame + 1, now // self.__frame_ns + 1)
        boundaries = [self.__boundary]
        while boundaries[-1].frame < last:
            boundaries.append(self.__take(boundaries[-1].frame + 1))
        reports = [self.__report(*pair, command) for pair in pairwise(boundaries)]
        *missed, report = reports
        report.sent, report.refusals, report.missed = receipt.sent, receipt.refusals, missed
        if receipt.refusals:
            report.limits |= int(Limit.POSTURE)
        if results := receipt.all_results(0, self.bridge.take_results()):
            report.results = {0: results}
        self.__watchdog = Watchdog(int(report.watchdog[0]))
        return report

    def __report(self, before: Boundary, after: Boundary, command: Command) -> FrameReport:
        """Report the frame between two boundaries."""
        end = after.state
        return report_of(
            self,
            before,
            after,
            requested="command" if isinstance(command, Goals) and command.setpoints is None else "requested",
            truth=partial(self.__truth_at, end, end["touches"] > before.state["touches"]),
            origin_ns=self.__origin,
        )

    def __take(self, number: int) -> Boundary:
        """Wait for a boundary of this number or, if that one was lost, a later one."""
        link, reader, words = self.link, self.__reader, self.link.block.words
        if reader is None:
            raise RealtimeError("The robot is in no episode. Call reset() first.")
        due = self.__origin + number * self.__frame_ns
        while True:
            boundary = reader.read()
            if boundary is not None and boundary.state["segment"] == words[Word.SEGMENT]:
                if boundary.frame >= number:
                    self.__boundary = boundary
                    words[Word.RECORDER_FRAMES] += boundary.frame > 0
                    words[Word.RECORDER_DROPS] = boundary.drops
                    return boundary
                continue
            left = due - time.monotonic_ns()
            if left < -_SILENCE_S * NANOSECONDS:
                link.check()
                raise RealtimeError(
                    f"Frame {number} was due {_SILENCE_S:g} s ago and has not come: the real-time process is "
                    "stopped, or gets no processor time. Without commands the robot holds by itself."
                )
            if left > 0:
                time.sleep(left / NANOSECONDS)
            else:
                link.wait()

    @property
    def problem(self) -> str:
        """What was wrong with the plant in its last fault, or which watchdog noticed something, as text."""
        noticed = ", ".join(str(flag.name).lower().replace("_", " ") for flag in self.__watchdog)
        return problem_of(self.bridge.latest) or (f"watchdog: {noticed}" if noticed else "no watchdog says why")

    @property
    def is_lost(self) -> bool:
        """Whether what drives the robot has ended, so that no reset helps."""
        return bool(self.link.block.words[Word.PLANT_LOST])

    @property
    def modes(self) -> NDArray[np.int8]:
        """The newest `Mode`, shape (1,)."""
        return self.bridge.state().mode

    def close(self) -> None:
        """End the robot's process and free the renderers. May be called twice."""
        super().close()
        self.link.close()


def _kind(simulation: type[Simulation], config: Any) -> tuple[Any, list[Any]]:
    """Return the class of a host, and what it is made of: a simulation, or with `config.plant` the plant's host."""
    if not config.plant:
        return simulation, [config]
    plant_class(config.plant)  # what cannot be imported is found out before a process is started
    return Host, [config, Unconnected()]


def mirror_of(simulation: type[Simulation], config: Any) -> Host:
    """Return a host like that of a robot on the wall clock, which never ticks.

    Raises:
        ConfigError: there is no such plant.
    """
    kind, arguments = _kind(simulation, config)
    mirror: Host = kind(*arguments)
    return mirror


def make_live(simulation: type[Simulation], config: Any, name: str | None) -> LiveHost:
    """Return a robot on the wall clock: a simulated one, or with `config.plant` that of a plant.

    Args:
        simulation: the class of its simulation.
        config: its configuration.
        name: the robot's id; its type and this process's number if None.

    Raises:
        ConfigError: there is no such plant.
        RealtimeError: its processes could not be started, or real time is required and was refused.
    """
    number = next(_nameless) if name is None else 0
    kind, arguments = _kind(simulation, config)
    made: Any = type(f"Live{kind.__name__}", (LiveHost, kind), {"runs": kind})
    host: LiveHost = made(*arguments, name=name or f"{config.type}-{os.getpid()}{f'-{number}' if number else ''}")
    return host


_nameless = itertools.count()  # several robots of one process that have no id
