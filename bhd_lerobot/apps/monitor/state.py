"""What `bhd-monitor` shows, as plain values, and how it is read from the block of a running robot."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from bhd_lerobot.apps.view.packing import finite
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Mode, Reason, Watchdog
from bhd_lerobot.control.motion.goal_codec import decode_feedback
from bhd_lerobot.control.record import command_age_ns
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.block import LiveBlock, Phase, Word
from bhd_lerobot.realtime.timing import TimingStatistics

LIMITS = tuple(limit.name or "" for limit in Limit if limit)
WATCHDOGS = tuple(watchdog.name or "" for watchdog in Watchdog if watchdog)
REASONS = tuple(reason.name for reason in Reason)
"""Names of what the states count, in their order."""
HEARTBEATS = {
    "brain": Word.BRAIN_ALIVE,
    "cerebellum": Word.CEREBELLUM_ALIVE,
}
POSE = ("x", "y", "yaw")

_NOTHING: dict[str, Any] = {"mode": None, "estop_latched": False, "command_age": None, "observation_age": None}
_NOTHING |= {"executed": 0, "skipped": 0, "overruns": 0}  # of a robot that has published nothing
_WINDOW_NS = 2 * NANOSECONDS  # over which rates are measured


@dataclass(frozen=True)
class Spread:
    """How a time is distributed over the ticks of the episode [s]."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True)
class Dimension:
    """One dimension of the command, in its own unit: the setpoint taken last, after all limits, where the robot is."""

    name: str
    requested: float | None  # None if there was none or a goal is followed
    applied: float
    measured: float


@dataclass(frozen=True)
class Count:
    """How often something happened in the episode, and how often in a second at present; None if that is unknown."""

    count: int
    per_second: float | None


@dataclass(frozen=True)
class MonitorState:
    """A running robot at one moment. Times in seconds, rates in Hz; None: unknown or without meaning at present."""

    id: str
    robot: str  # its type
    clock: str
    uptime: float  # since it was started
    phase: str  # what the loop does, a name of `Phase`
    episode: int  # number of the segment of ticks that runs or ran last, from 1; 0 before the first
    episode_time: float | None
    mode: str | None  # a name of `Mode`
    estop: bool  # the word of the emergency stop is set
    estop_latched: bool  # by the cerebellum
    control_rate: float | None  # measured over the last two seconds, as all rates
    control_hz: int  # wanted
    frame_rate: float | None  # that the brain's process reads; None if it reads none
    fps: int  # wanted
    command_rate: float | None  # setpoints that the cerebellum takes
    executed: int  # ticks of the episode
    skipped: int  # ticks that were left out
    overruns: int  # ticks that ended after the next was due
    catch_up_lost: int  # ticks by which the simulated world fell behind
    recorder_drops: int  # states that were overwritten before the brain's process read them
    lateness: Spread | None  # of the ticks' starts
    duration: Spread | None  # of the ticks
    fifo_fill: int  # commands that wait
    fifo_capacity: int
    command_age: float | None  # of the setpoint that is followed
    observation_age: float | None  # of the newest observation's oldest reading
    dimensions: tuple[Dimension, ...] = ()
    limits: dict[str, Count] = field(default_factory=dict)  # by name of `Limit`, counted once a frame
    watchdogs: dict[str, Count] = field(default_factory=dict)  # by name of `Watchdog`
    refusals: dict[str, int] = field(default_factory=dict)  # by name of `Reason`; those that occurred
    alive: dict[str, float | None] = field(default_factory=dict)  # since the last sign of life; None: not watched
    goal: dict[str, Any] | None = None  # the fields of the `Feedback` about the goal that is followed
    pose: dict[str, float] = field(default_factory=dict)  # odometry x, y [m] and yaw [rad] of a robot that drives

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; what is not finite is None."""
        plain: dict[str, Any] = finite(asdict(self))
        return plain


class Sampler:
    """Reads the block of a running robot, by the robot's monotonic clock [ns]; changes nothing in it."""

    def __init__(self, block: LiveBlock, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._block, self._clock = block, clock
        self._started = int(block.about["made_ns"])
        self._statistics = block.section("statistics")
        self._past: deque[_Counts] = deque()
        self._spreads: tuple[Spread | None, Spread | None] = (None, None)

    def end(self) -> str | None:
        """Return as text how the robot ended, ``"ended"`` if that was in order, or None if it still runs."""
        words = self._block.words
        if self._block.phase == Phase.ENDED:
            # The brain's process asks for both; a loop that finds itself alone has at most one of them.
            if words[Word.END] and words[Word.PAUSE]:
                return "ended"
            return "came to rest and ended by itself: its brain's process has ended"
        return None if self._block.is_held else "disappeared without ending: its processes were killed"

    def sample(self) -> MonitorState:
        """Return what is so now."""
        block, words, about = self._block, self._block.words.copy(), self._block.about
        state: Any = block.ring.latest()
        now = self._clock()
        phase = block.phase
        running = phase == Phase.RUNNING
        rates = self._rates(now, words, state)
        self._spreads = self._read_spreads()
        moment = {} if state is None else self._of_state(state, now, running, rates)
        return MonitorState(
            id=block.name,
            robot=str(about.get("robot", "?")),
            clock="realtime",
            uptime=(now - self._started) / NANOSECONDS,
            phase=phase.name,
            episode=int(words[Word.SEGMENT]),
            episode_time=max(0, now - int(words[Word.START])) / NANOSECONDS if running else None,
            estop=bool(words[Word.ESTOP] != words[Word.ESTOP_ACKNOWLEDGED]),
            control_rate=rates.get("executed"),
            control_hz=int(about["control_hz"]),
            frame_rate=rates.get("frames") if words[Word.RECORDER_FRAMES] else None,
            fps=int(about["fps"]),
            command_rate=rates.get("setpoints"),
            catch_up_lost=int(words[Word.CATCH_UP_LOST]),
            recorder_drops=int(words[Word.RECORDER_DROPS]),
            lateness=self._spreads[0],
            duration=self._spreads[1],
            fifo_fill=len(block.fifo),
            fifo_capacity=block.fifo.capacity,
            alive={
                name: max(0, now - int(words[word])) / NANOSECONDS if words[word] else None
                for name, word in HEARTBEATS.items()
            },
            **_NOTHING | moment,
        )

    def _of_state(self, state: Any, now: int, running: bool, rates: dict[str, float]) -> dict[str, Any]:
        """Return what a published state says."""
        record, goal = state["state"], decode_feedback(state["feedback"])
        mode = Mode(int(record["mode"]))
        by_setpoint = mode == Mode.TRACKING and goal is None
        requested = record["requested"].tolist() if int(record["setpoints_taken"]) and goal is None else None
        age = (int(command_age_ns(record, state["now_ns"])) + now - int(state["due_ns"])) / NANOSECONDS
        seen = (int(state["oldest_ns"]) + now - int(state["sensed_ns"])) / NANOSECONDS
        values = zip(
            self._block.about["commands"], record["command"].tolist(), record["measured"].tolist(), strict=False
        )
        refusals = dict(zip(REASONS, record["refusals"].tolist(), strict=True))
        counts = {
            key: {name: Count(int(n), rates.get(f"{key}.{name}")) for name, n in zip(names, state[key], strict=True)}
            for key, names in (("limits", LIMITS), ("watchdogs", WATCHDOGS))
        }
        return {
            **{name: int(state[name]) for name in ("executed", "skipped", "overruns")},
            "mode": mode.name,
            "estop_latched": mode == Mode.ESTOP,
            "command_age": max(0.0, age) if by_setpoint and running else None,
            "observation_age": max(0.0, seen) if running else None,
            "dimensions": tuple(
                Dimension(name, None if requested is None else requested[i], applied, measured)
                for i, (name, applied, measured) in enumerate(values)
            ),
            **counts,
            "refusals": {name: n for name, n in refusals.items() if n and name != Reason.ACCEPTED.name},
            "goal": goal and {**asdict(goal), "phase": goal.phase.name},
            "pose": dict(zip(POSE, record["odometry"].tolist(), strict=True))
            if self._block.about.get("drives")
            else {},
        }

    def _rates(self, now: int, words: Any, state: Any) -> dict[str, float]:
        """Return how often things happen in a second, over the window that lies within the present segment."""
        segment = int(words[Word.SEGMENT])
        if state is None or int(state["segment"]) != segment or words[Word.PHASE] != Phase.RUNNING:
            self._past.clear()
            return {}
        counts = {
            "executed": int(state["executed"]),
            "setpoints": int(state["state"]["setpoints_taken"]),
            "frames": int(words[Word.RECORDER_FRAMES]),
        }
        for key, names in (("limits", LIMITS), ("watchdogs", WATCHDOGS)):
            counts |= {f"{key}.{name}": int(n) for name, n in zip(names, state[key], strict=True)}
        newest = _Counts(segment, now, int(state["start_ns"]), counts)
        past = self._past
        while past and (past[0].segment != segment or (len(past) > 1 and now - past[1].now > _WINDOW_NS)):
            past.popleft()
        past.append(newest)
        oldest = past[0]
        if newest.now - oldest.now < NANOSECONDS // 10:
            return {}
        rates = {key: (n - oldest.counts[key]) * NANOSECONDS / (now - oldest.now) for key, n in counts.items()}
        # Ticks are counted to the tick: by when they started, unless the newest is long ago and the loop hangs.
        if newest.started > oldest.started and now - newest.started < NANOSECONDS // 4:
            ticks = counts["executed"] - oldest.counts["executed"]
            rates["executed"] = ticks * NANOSECONDS / (newest.started - oldest.started)
        return rates

    def _read_spreads(self) -> tuple[Spread | None, Spread | None]:
        try:
            view = TimingStatistics.view(self._statistics)
        except ConfigError:  # the process has not begun to count, or begins anew at this very moment
            return self._spreads
        copy = view.copy()
        view.release()
        if not copy.ticks:
            return None, None
        total = copy.summary(clock="realtime")
        return (
            Spread(total.lateness_p50, total.lateness_p99, total.lateness_max),
            Spread(total.duration_p50, total.duration_p99, total.duration_max),
        )


@dataclass(frozen=True)
class _Counts:
    segment: int
    now: int
    started: int
    counts: dict[str, int]
