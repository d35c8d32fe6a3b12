"""Looks on while others command a robot on the wall clock: its frames, as those of episodes that they command."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command, CommandResult, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.record import command_age_ns
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.frame_reader import FrameReader
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.robots.host.frames import frame_of, report_of
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.robots import Frame, FrameReport
from bhd_lerobot.tasks.task import Event

_SILENCE_S = 2.0  # so long without a frame the loop is stopped, or has ended
_PAUSE_S = 0.01  # the ring holds seconds
_RESULTS = 256  # that are kept while nothing is recorded
_EVENTS = {ResultCode.SUCCEEDED: Event.SUCCESS, ResultCode.TIMEOUT: Event.TIMEOUT}
_EVENTS |= {ResultCode.ESTOP: Event.ESTOP, ResultCode.FAULT: Event.FAULT}


class Onlooker:
    """One robot on the wall clock that others command; see `Robots`. Commands nothing, and nothing waits for it.

    An episode begins with the frame in which a command is followed. It ends with the result of a goal, when no command
    was followed for some time, or with what is read. How it ended is the truth of its last frame, an `Event`.

    Attributes:
        results: how goals ended, each with the time when it was known, monotonic [ns]; others append to it.
        ended_by: the result that ended the episode, if one did.

    Args:
        mirror: a host like the one that runs, for this object alone.
        idle_s: an episode ends when no command was followed for so long [s].
        ending: returns how the running episode ends if nothing more will be read; None while that is not so.
    """

    n, world, estop_pressed, problem = 1, None, False, ""

    def __init__(self, mirror: Host, idle_s: float, ending: Callable[[], Event | None]) -> None:
        self.mirror, self.config, self.rates, self.body = mirror, mirror.config, mirror.rates, mirror.body
        self.knows, self.columns = mirror.knows, mirror.columns
        self.action_names, self.observation_names = mirror.action_names, mirror.observation_names
        self.camera_shapes = mirror.camera_shapes
        self.track, self.start_rendering, self.render_later = mirror.track, mirror.start_rendering, mirror.render_later
        self.running = np.zeros(1, np.bool_)
        self.notes: list[str] = []
        self.results: deque[tuple[int, CommandResult]] = deque(maxlen=_RESULTS)
        self.ended_by: CommandResult | None = None
        self._idle_ns, self._ending = round(idle_s * NANOSECONDS), ending
        self._at: Any = None  # the boundary that the present frame begins with
        self._ahead: Any = None  # the boundary that it ends with, if that was read
        self._first: Any = None  # the boundary that the episode began with
        self._followed_ns = 0  # when a command was followed last

    def attach(self, name: str, grants: list[dict[str, Any]]) -> None:
        """Read the frames of the running robot of a name from now on.

        Args:
            grants: what its process was granted and refused.
        """
        self._block = block = LiveBlock.watch(name)
        self._reader = FrameReader(block.ring, self.rates.ticks_per_frame)
        self.clock = OnlookerClock(block.section("statistics"), self.mirror.sensor_period_s, grants)

    def close(self) -> None:
        """Leave the robot's memory."""
        self.clock.release()
        self._block.close()

    def _read(self) -> Any:
        """Return the next boundary; None if none comes: all is over, or the robot is silent."""
        since = time.monotonic_ns()
        while (boundary := self._reader.read()) is None:
            if self._ending() is not None or time.monotonic_ns() - since > _SILENCE_S * NANOSECONDS:
                return None
            time.sleep(_PAUSE_S)
        return boundary

    def wait(self) -> bool:
        """Wait until a command is followed; return false if all is over before."""
        while True:
            before, after = self._at, self._ahead
            if after is None:
                after = self._read()
            if after is None:
                if self._ending() is not None:
                    return False
                self._at = None  # of a robot that was silent, nothing is known of what came before
                continue
            if before is not None and self._is_followed(after.state):
                self._ahead = after
                return True
            self._at, self._ahead = after, None

    def _is_followed(self, state: Any) -> bool:
        """Return whether a command is followed; zero speed is none for a base that nobody drives."""
        record = state["state"]
        if record["mode"] != Mode.TRACKING:
            return False
        stands = self.body.drive is not None and not record["requested"].any()
        return not (stands and command_age_ns(record, state["now_ns"]))

    # --- an episode, see `Robots` ------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Begin an episode where the robot is; `wait` has found its first frame."""
        self._first, self._followed_ns = self._at, int(self._ahead.state["sensed_ns"])
        self.ended_by = None
        self._take_results(int(self._at.state["sensed_ns"]))  # of goals before
        self.clock.restart()
        self.running[:] = True
        return np.zeros((1, 0))

    def stop(self, ids: NDArray[np.intp]) -> None:
        """End the episode; the robot goes on as it is."""
        self.running[:] = False

    def observe(self) -> Frame:
        """Return the observation that the present frame began with, no older than when it was read."""
        state = self._at.state
        return frame_of(self.mirror, state, int(state["sensed_ns"]), self._origin_ns)

    def step(self, command: Command) -> FrameReport:
        """Report the present frame, once the next is over or is known not to come."""
        before, after = self._at, self._ahead
        self._at, self._ahead = after, self._read()
        state = after.state
        event = np.array([int(self._judge(state))])
        report = report_of(
            self.mirror,
            before,
            after,
            # What was requested before a goal, or before the robot stopped by itself, is not what it follows.
            requested="requested" if command_age_ns(state["state"], state["now_ns"]) else "command",
            truth=lambda: event,
            origin_ns=self._origin_ns,
        )
        report.number -= self._first.frame
        return report

    @property
    def _origin_ns(self) -> int:
        return int(self._first.state["sensed_ns"])

    def _judge(self, state: Any) -> Event:
        """Return how the episode ends with a frame, by the state at its end."""
        now = int(state["sensed_ns"])
        if state["state"]["mode"] == Mode.TRACKING:
            self._followed_ns = now
        if results := self._take_results(now):
            self.ended_by = results[0]
            return _EVENTS.get(self.ended_by.code, Event.FAILURE)
        if now - self._followed_ns > self._idle_ns:
            return Event.TIMEOUT
        if self._ahead is None:
            return self._ending() or Event.FAULT
        return Event.NOTHING

    def _take_results(self, until_ns: int) -> list[CommandResult]:
        taken = []
        while self.results and self.results[0][0] <= until_ns:
            taken.append(self.results.popleft()[1])
        return taken

    def truth(self) -> NDArray[np.int64]:
        """Return that the episode goes on."""
        return np.array([int(Event.NOTHING)])

    def estop(self) -> None:
        """Do nothing: the robot is commanded by others."""


class OnlookerClock:
    """How punctual a robot is whose loop does not begin anew with an episode; see `Clock`.

    Args:
        section: the memory in which its process counts ticks.
        sensor_period_s: time between two readings of the slowest sensor [s].
        grants: what its process was granted and refused.
    """

    def __init__(self, section: memoryview, sensor_period_s: float, grants: list[dict[str, Any]] | None) -> None:
        self._all = TimingStatistics.view(section)
        self.sensor_period_s, self.grants = sensor_period_s, grants
        self.restart()

    def restart(self) -> None:
        """Count from now on."""
        self._before = self._all.copy()

    def statistics(self) -> TimingStatistics:
        """Return how punctual the ticks of the present episode are, as far as it is known when it is read."""
        return self._all.since(self._before)

    def release(self) -> None:
        """Let go of the memory."""
        self._all.release()
