"""What the real-time process publishes at every tick: the record of the robot, and what else its readers need."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.control.motion.goal_codec import FEEDBACK_DTYPE, write_feedback
from bhd_lerobot.control.record import STATE
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.robots.host.host import Host

LIMITS, WATCHDOGS = tuple(limit for limit in Limit if limit), tuple(watchdog for watchdog in Watchdog if watchdog)

_PROBLEM_BYTES = 400
_NUMBERS = {
    "tick": "number on the grid of its segment",
    "segment": "number of the segment",
    "now_ns": "the cerebellum's time of the tick [ns]",
    "due_ns": "when the tick was due, monotonic [ns]",
    "start_ns": "when it started, monotonic [ns]",
    "ended_ns": "when the tick before it ended, monotonic [ns]",
    "executed": "ticks executed so far in the segment",
    "skipped": "ticks skipped so far",
    "overruns": "ticks so far that ended after their successor was due",
    "sensed_ns": "when the observation was read, monotonic [ns]",
    "oldest_ns": "how much older the oldest reading in it was [ns]",
}


def published(host: Host) -> dict[str, tuple[Any, tuple[int, ...], str]]:
    """Return the table of what one robot publishes: type, shape and meaning by name.

    What is counted is counted since the start of the segment; limits and watchdogs once a frame.
    """
    physics = sum(part.shape[1] for part in host.physics)
    return {
        "state": (STATE, (), "the record of the tick, see `bhd_lerobot.control.record`"),
        **{name: (np.int64, (), meaning) for name, meaning in _NUMBERS.items()},
        "limits": (np.int64, (len(LIMITS),), "how often each of `LIMITS` changed a command"),
        "watchdogs": (np.int64, (len(WATCHDOGS),), "how often each of `WATCHDOGS` noticed something"),
        "touches": (np.int64, (len(host.touches),), "ticks with a touch, by kind"),
        "observation": (np.float64, (1, len(host.sensed_names)), "what is sensed of the observation"),
        "physics": (np.float64, (1, physics), "the simulator's generalised positions and velocities"),
        "feedback": (FEEDBACK_DTYPE, (), "how far the goal is that is followed, once a frame"),
        "problem": (f"S{_PROBLEM_BYTES}", (), "what is wrong in FAULT, in UTF-8"),
    }


def published_dtype(host: Host) -> np.dtype:
    """Return the dtype of what one robot publishes."""
    return np.dtype([(name, kind, shape) for name, (kind, shape, _) in published(host).items()], align=True)


def problem_of(row: Any) -> str:
    """Return what is wrong with a robot by what it published, as text; empty if nothing is."""
    return bytes(row["problem"]).decode(errors="ignore")


class StatePublisher:
    """Publishes the states of one robot, into a ring.

    Args:
        ring: where they go, of dtype `published_dtype(host)`.
        clock: monotonic time [ns].
        age_ns: how much older than the tick its newest reading is [ns]; not older if None.
        problem: what is wrong with the robot now, as text; called in FAULT.
    """

    def __init__(
        self,
        host: Host,
        ring: StateRing,
        clock: Callable[[], int] = time.monotonic_ns,
        age_ns: Callable[[], int] | None = None,
        problem: Callable[[], str] = str,
    ) -> None:
        self._clock, self._age_ns, self._problem = clock, age_ns, problem
        self._host, self._cerebellum, self._ring = host, host.cerebellum, ring
        self._record = record = np.zeros(1, published_dtype(host))
        # Views, because an index costs as much as a write, and bytes, because numpy copies structures field by field.
        self._row = record[0]
        self._state, self._source = record.view(np.uint8)[: STATE.itemsize], self._cerebellum.states.view(np.uint8)
        self._numbers = np.frombuffer(record.data, np.int64, len(_NUMBERS), record.dtype.fields["tick"][1])
        self._observation, self._feedback = record["observation"][0], self._row["feedback"]
        self._counted = {name: record[name][0] for name in ("limits", "watchdogs", "touches")}
        nq = host.physics[0].shape[1]
        self._physics = record["physics"][0, :, :nq], record["physics"][0, :, nq:]
        self._frame = host.rates.ticks_per_frame
        self._next_frame = 0
        self._was_faulty = False
        self.segment = 0

    def restart(self, segment: int) -> None:
        """Begin a new segment."""
        self.segment = segment
        self._next_frame = 0
        for counts in self._counted.values():
            counts[:] = 0

    def publish(self, slot: Slot, start_ns: int, ended_ns: int, grid: TickGrid) -> None:
        """Publish the state at the end of a tick.

        Args:
            start_ns: when it started [ns].
            ended_ns: when its predecessor ended [ns].
        """
        host, cerebellum = self._host, self._cerebellum
        is_new = self._count(slot)
        is_faulty = cerebellum.mode[0] == Mode.FAULT
        if is_faulty != self._was_faulty or (is_faulty and is_new):
            self._was_faulty = is_faulty
            self._record["problem"] = self._problem().encode()[:_PROBLEM_BYTES] if is_faulty else b""
        self._state[:] = self._source
        _, oldest = host.sense(self._observation)
        self._numbers[:] = (
            slot.index,
            self.segment,
            slot.due_ns - grid.start_ns,
            slot.due_ns,
            start_ns,
            ended_ns,
            grid.executed,
            grid.skipped,
            grid.overruns,
            # Before the first tick everything stands still: what is read then is so until that tick.
            self._clock() if slot.index >= 0 else slot.due_ns,
            (host.tick - int(oldest[0])) * grid.period_ns + (self._age_ns() if self._age_ns else 0),
        )
        self._physics[0][:], self._physics[1][:] = host.physics
        self._ring.publish(self._record)

    def restate(self) -> None:
        """Publish the last state once more, with what is known by now to be wrong."""
        if self._was_faulty:
            self._record["problem"] = self._problem().encode()[:_PROBLEM_BYTES]
            self._ring.publish(self._record)

    def _count(self, slot: Slot) -> bool:
        """Count what was raised since the last tick; limits and watchdogs at the last tick of every frame.

        Returns:
            Whether it was the last tick of a frame.
        """
        for kind, flag in enumerate(self._host.touches):
            if flag[0]:
                self._counted["touches"][kind] += 1
                flag[0] = False
        # The state that a frame ends with holds all that was raised in it, also if its last tick was skipped.
        frame = (slot.index + 1) // self._frame
        if frame < self._next_frame:
            return False
        self._next_frame = frame + 1
        write_feedback(self._feedback, self._cerebellum.controller.feedback(0))
        limits, watchdog = self._cerebellum.take_flags()
        for name, raised, kinds in (("limits", limits, LIMITS), ("watchdogs", watchdog, WATCHDOGS)):
            if flags := int(raised[0]):
                self._counted[name] += [bool(flags & kind) for kind in kinds]
        return True


def raised(before: Any, after: Any) -> tuple[int, int]:
    """Return the `Limit` and `Watchdog` flags that were raised between two published states."""
    limits = sum(int(limit) for limit, more in zip(LIMITS, after["limits"] > before["limits"], strict=True) if more)
    seen: NDArray[np.bool_] = after["watchdogs"] > before["watchdogs"]
    return limits, sum(int(flag) for flag, more in zip(WATCHDOGS, seen, strict=True) if more)
