"""What the real-time process publishes at every tick."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import MOVING
from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.messages import Limit, Mode, Reason, Watchdog
from bhd_lerobot.control.motion.goal_codec import FEEDBACK_DTYPE, write_feedback
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.robots.host.host import Host

LIMITS, WATCHDOGS = tuple(limit for limit in Limit if limit), tuple(watchdog for watchdog in Watchdog if watchdog)

_PROBLEM_BYTES = 400
# The numbers that a state begins with, in the order in which they are written.
_NUMBERS = (
    *("tick", "segment", "due_ns", "start_ns", "ended_ns", "executed", "skipped", "overruns"),
    *("setpoints", "waiting", "command_age_ns", "sensed_ns", "oldest_ns"),
)


def state_dtype(host: Host) -> np.dtype:
    """Return the dtype of the published states of one robot.

    Beside the fields of `CerebellumState`:

    - ``tick``: number on the grid of its segment; ``segment``: number of the segment.
    - ``due_ns``, ``start_ns``: when the tick was due and when it started, monotonic; ``ended_ns``: when the tick before
      it ended.
    - ``executed``, ``skipped``, ``overruns``: ticks so far in the segment.
    - ``requested``, ``setpoints``: the setpoint taken last, and how many were taken; ``command_age_ns``: its age if it
      is followed; ``waiting``: entries in the queue.
    - ``limits``, ``watchdogs``, ``refusals``, ``touches``: how often each was raised so far, of `LIMITS`, `WATCHDOGS`,
      `Reason`, and of the kinds of touches of the simulation. Limits are counted once a frame.
    - ``feedback``: how far the goal is that is followed, once a frame.
    - ``problem``: what is wrong in FAULT, in UTF-8, see `problem_of`.
    - ``observation``: the observation's floats; ``sensed_ns``: when they were read, monotonic; ``oldest_ns``: how much
      older the oldest reading in them was.
    - ``physics``: the simulator's generalised positions and velocities; of no width without one.
    """
    cerebellum = host.cerebellum
    own = vars(cerebellum.state(0))
    physics = sum(part.shape[1] for part in host.physics)
    return np.dtype(
        [
            *((name, np.int64) for name in _NUMBERS),
            *((name, value.dtype, value.shape) for name, value in own.items() if name != "stamp_ns"),
            ("requested", np.float64, (1, cerebellum.width)),
            ("limits", np.int64, (len(LIMITS),)),
            ("watchdogs", np.int64, (len(WATCHDOGS),)),
            ("refusals", np.int64, (len(Reason),)),
            ("touches", np.int64, (len(host.touches),)),
            ("observation", np.float64, (1, len(host.observation_names))),
            ("physics", np.float64, (1, physics)),
            ("feedback", FEEDBACK_DTYPE),
            ("problem", f"S{_PROBLEM_BYTES}"),
        ]
    )


def problem_of(state: Any) -> str:
    """Return what is wrong with a robot by its state, as text; empty if nothing is."""
    return bytes(state["problem"]).decode(errors="ignore")


class StatePublisher:
    """Publishes the states of one robot, into a ring.

    Args:
        ring: where they go, of dtype `state_dtype(host)`.
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
        self._record = np.zeros(1, state_dtype(host))
        # The one robot's values, as views: an index costs as much as a write.
        self._field = {name: self._record[name][0] for name in self._record.dtype.names or ()}
        self._state = self._record[0]
        self._speed = np.zeros_like(host.cerebellum.reading.velocity)
        self._numbers = np.frombuffer(self._record.data, np.int64, len(_NUMBERS))  # one write instead of thirteen
        self._feedback = self._state["feedback"]
        self._touches = np.zeros(len(host.touches), np.int64)
        self._limits, self._watchdogs = np.zeros(len(LIMITS), np.int64), np.zeros(len(WATCHDOGS), np.int64)
        nq = host.physics[0].shape[1]
        self._physics = self._field["physics"][:, :nq], self._field["physics"][:, nq:]
        self._frame = host.rates.ticks_per_frame
        self._next_frame = 0
        self._was_faulty = False
        self.segment = 0

    def restart(self, segment: int) -> None:
        """Begin a new segment."""
        self.segment = segment
        self._next_frame = 0
        self._limits[:] = self._watchdogs[:] = self._touches[:] = 0

    def publish(self, slot: Slot, start_ns: int, ended_ns: int, grid: TickGrid) -> None:
        """Publish the state at the end of a tick.

        Args:
            start_ns: when it started [ns].
            ended_ns: when its predecessor ended [ns].
        """
        host, cerebellum, field = self._host, self._cerebellum, self._field
        is_new = self._count(slot)
        is_faulty = cerebellum.mode[0] == Mode.FAULT
        if is_faulty != self._was_faulty or (is_faulty and is_new):
            self._was_faulty = is_faulty
            self._record["problem"] = self._problem().encode()[:_PROBLEM_BYTES] if is_faulty else b""
        controller, reading = cerebellum.controller, cerebellum.reading
        field["joint_positions"][:], field["joint_velocities"][:] = reading.position, reading.velocity
        field["joint_efforts"][:] = cerebellum.efforts()
        field["contact_wrench"][:], field["pressed"][:] = controller.contact_wrench, controller.pressed()
        field["command"][:], field["measured"][:] = cerebellum.command, controller.measured(reading)
        field["odometry"][:] = controller.odometry()
        field["mode"][:], field["requested"][:] = cerebellum.mode, cerebellum.requested
        np.abs(reading.velocity, out=self._speed)
        field["is_moving"][:] = np.count_nonzero(self._speed > MOVING) > 0
        field["emergency_stop"][:] = cerebellum.mode == Mode.ESTOP
        field["refusals"][:] = cerebellum.refusals[:, 0]
        field["observation"][:], oldest = host.sense()
        self._numbers[:] = (
            slot.index,
            self.segment,
            slot.due_ns,
            start_ns,
            ended_ns,
            grid.executed,
            grid.skipped,
            grid.overruns,
            cerebellum.setpoints_taken,
            len(cerebellum.fifo),
            cerebellum.command_age_of(0, slot.due_ns - grid.start_ns),
            # Before the first tick everything stands still: what is read then is so until that tick.
            self._clock() if slot.index >= 0 else slot.due_ns,
            (host.tick - int(oldest[0])) * grid.period_ns + (self._age_ns() if self._age_ns else 0),
        )
        self._physics[0][:], self._physics[1][:] = host.physics
        self._ring.publish(self._state)

    def restate(self) -> None:
        """Publish the last state once more, with what is known by now to be wrong."""
        if self._was_faulty:
            self._record["problem"] = self._problem().encode()[:_PROBLEM_BYTES]
            self._ring.publish(self._state)

    def _count(self, slot: Slot) -> bool:
        """Count what was raised since the last tick; limits and watchdogs at the last tick of every frame.

        Returns:
            Whether it was the last tick of a frame.
        """
        field = self._field
        flags = [flag[0] for flag in self._host.touches]
        if any(flags):
            self._touches += flags
            field["touches"][:] = self._touches
            for flag in self._host.touches:
                flag[0] = False
        # The state that a frame ends with holds all that was raised in it, also if its last tick was skipped.
        frame = (slot.index + 1) // self._frame
        if frame < self._next_frame:
            return False
        self._next_frame = frame + 1
        write_feedback(self._feedback, self._cerebellum.controller.feedback(0))
        limits, watchdog = self._cerebellum.take_flags()
        raised = int(limits[0])
        if raised:
            self._limits += [bool(raised & limit) for limit in LIMITS]
            field["limits"][:] = self._limits
        raised = int(watchdog[0])
        if raised:
            self._watchdogs += [bool(raised & watchdog) for watchdog in WATCHDOGS]
            field["watchdogs"][:] = self._watchdogs
        return True


def raised(before: Any, after: Any) -> tuple[int, int]:
    """Return the `Limit` and `Watchdog` flags that were raised between two published states."""
    limits = sum(int(limit) for limit, more in zip(LIMITS, after["limits"] > before["limits"], strict=True) if more)
    seen: NDArray[np.bool_] = after["watchdogs"] > before["watchdogs"]
    return limits, sum(int(flag) for flag, more in zip(WATCHDOGS, seen, strict=True) if more)
