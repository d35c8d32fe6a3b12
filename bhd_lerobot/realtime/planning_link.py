"""Planning in another process: requests and plans through shared memory.

The cerebellum's side writes a request, and the planner's side writes the rows of the plan into one of two blocks, from
which they are played where they lie. The request states which block may be written to: never the one that is played.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import HELD, Capsule
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.kernels import fence
from bhd_lerobot.control.motion.goal_codec import (
    MESSAGE_BYTES,
    decode_goal,
    decode_message,
    goal_dtype,
    write_goal,
    write_message,
)
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.control.motion.planning import LEAD_S, TIMEOUT_S, lead_ticks
from bhd_lerobot.control.motion.trajectory import MAX_DURATION_S, PlanFailure, State, Trajectory
from bhd_lerobot.errors import ConfigError

_LOG = logging.getLogger(__name__)
_SLACK_S = 5.0  # [s] a trajectory may be longer than `MAX_DURATION_S` by a brake before it


def _header_dtype(dof: int, width: int) -> np.dtype:
    request = np.dtype(
        [
            ("number", np.int64),
            ("start_tick", np.int64),
            ("block", np.int64),
            ("state", np.float64, (3, width)),
            ("has_opening", np.bool_),
            ("opening", np.float64),
            ("held", np.float64, (7,)),  # both ends and the radius of what is in the gripper [m]; 0 without it
            ("goal", goal_dtype(dof)),
        ],
        align=True,
    )
    return np.dtype(
        [
            # Odd while the request is being written: a reader that sees it change reads again.
            ("guard", np.int64),
            ("request", request),
            ("dropped", np.int64),  # the last request that no answer is wanted to
            # Written last: the number of the request that what follows is the answer to. Only the answer to the newest
            # request is read, and none is written before there is a newer one.
            ("answered", np.int64),
            ("code", np.int64),
            ("message", f"S{MESSAGE_BYTES}"),
            ("message_size", np.int16),
            ("rows", np.int64),
            ("target", np.float64, (width,)),
        ],
        align=True,
    )


class _Memory:
    """The block of memory that both sides share."""

    def __init__(self, buffer: Any, dof: int, width: int, control_hz: int, duration_s: float) -> None:
        dtype = _header_dtype(dof, width)
        capacity = self.capacity(control_hz, duration_s)
        self.header = np.frombuffer(buffer, dtype, 1)
        shape = (2, capacity, 3, width)
        self.rows = np.frombuffer(buffer, np.float64, int(np.prod(shape)), offset=dtype.itemsize).reshape(shape)
        # One-element views: an aligned 64-bit store is atomic, see `CommandFifo`.
        self.guard, self.dropped, self.answered = (self.header[name] for name in ("guard", "dropped", "answered"))

    @staticmethod
    def capacity(control_hz: int, duration_s: float) -> int:
        return int(np.ceil((duration_s + _SLACK_S) * control_hz))


class PlanningLink:
    """The cerebellum's side: a `Planning` for one arm that another process plans for.

    Attributes:
        lead: ticks from a request to the tick that its plan is to start at.

    Args:
        buffer: memory of at least `nbytes(dof, width, control_hz, duration_s)` bytes, zeroed before its first use.
        dof: number of the arm's joints.
        width: number of values of its state: with the gripper's opening, if it has one.
        control_hz: ticks a second [Hz].
        lead_s: from a request to the start of its plan [s].
        timeout_s: that an answer may take [s].
        duration_s: the longest trajectory [s]; the same on both sides.
    """

    def __init__(
        self,
        buffer: Any,
        dof: int,
        width: int,
        control_hz: int,
        *,
        lead_s: float = LEAD_S,
        timeout_s: float = TIMEOUT_S,
        duration_s: float = MAX_DURATION_S,
    ) -> None:
        if not (np.isfinite(timeout_s) and timeout_s > 0):
            raise ConfigError(f"The planner's time-out is {timeout_s!r} s; it must be positive, such as {TIMEOUT_S}.")
        self.lead, self.timeout = lead_ticks(control_hz, lead_s), round(timeout_s * control_hz)
        self._memory = memory = _Memory(buffer, dof, width, control_hz, duration_s)
        self._request: Any = memory.header["request"][0]
        self._answer: Any = memory.header[0]
        self._guard, self._dropped, self._answered = memory.guard, memory.dropped, memory.answered
        if self._guard.item() % 2:  # the process that had the memory before was killed while writing
            self._guard[0] += 1
        self._number = int(self._request["number"])
        self._out = False  # whether an answer is wanted
        self._played = 1  # the block that is, or may be, played

    @staticmethod
    def nbytes(dof: int, width: int, control_hz: int, duration_s: float = MAX_DURATION_S) -> int:
        """Return the size of the memory block [bytes]."""
        return _header_dtype(dof, width).itemsize + 2 * _Memory.capacity(control_hz, duration_s) * 3 * width * 8

    def request(  # noqa: PLR0917
        self,
        sim: int,
        command: BrainCommand,
        state: State,
        opening: float | None,
        start_tick: int,
        held: Capsule | None = None,
    ) -> None:
        """Ask for a plan."""
        if sim:
            raise ConfigError(f"A plan for arm {sim} was requested; another process plans for one arm only, number 0.")
        self._number += 1
        self._dropped[0] = self._number - 1
        request = self._request
        self._guard[0] += 1
        fence()
        request["number"], request["start_tick"], request["block"] = self._number, start_tick, 1 - self._played
        rows = request["state"]
        rows[0], rows[1], rows[2] = state.position, state.velocity, state.acceleration
        request["has_opening"], request["opening"] = opening is not None, 0.0 if opening is None else opening
        request["held"] = 0.0 if held is None else (*held.start, *held.end, held.radius)
        write_goal(request["goal"], command)
        fence()
        self._guard[0] += 1
        self._out = True

    def poll(self, sim: int) -> Plan | PlanFailure | None:
        """Return the answer; the rows of a plan are the shared ones."""
        if not self._out or self._answered.item() != self._number:
            return None
        fence()
        self._out = False
        answer = self._answer
        if answer["code"] != ResultCode.SUCCEEDED:
            return PlanFailure(ResultCode(int(answer["code"])), decode_message(answer))
        rows = self._memory.rows[1 - self._played, : int(answer["rows"])]
        return Plan(Trajectory(rows[:, 0], rows[:, 1], rows[:, 2]), answer["target"].copy(), rows)

    def begin(self, sim: int) -> None:
        """Keep the rows of the plan that was polled last as they are: they are played."""
        self._played = 1 - self._played

    def drop(self, sim: int) -> None:
        """Want no answer any more; what was polled and has not begun may be overwritten by the next answer."""
        self._out = False
        self._dropped[0] = self._number


class PlanServer:
    """The planner's side, for one thread.

    Attributes:
        newest: the trajectory of the last plan that was answered with; None before there is one.

    Args:
        duration_s: the longest trajectory [s]; the same on both sides.
    """

    def __init__(self, buffer: Any, planner: GoalPlanner, *, duration_s: float = MAX_DURATION_S) -> None:
        self.newest: Trajectory | None = None
        self._planner = planner
        self._memory = memory = _Memory(buffer, planner.dof, planner.width, planner.hz, duration_s)
        self._header: Any = memory.header[0]
        self._guard, self._dropped, self._answered = memory.guard, memory.dropped, memory.answered
        # A request that another server has not answered is served; one that was answered is not served again.
        self._served, self._seen_guard = self._answered.item(), -1

    def serve(self, stop: Callable[[], bool], sleep: Callable[[], None]) -> None:
        """Serve until `stop` returns true; sleep when there is no request, a millisecond or so at a time."""
        while not stop():
            if not self.serve_once():
                sleep()

    def serve_once(self) -> bool:
        """Answer the newest request; return whether there was one."""
        request = self._take()
        if request is None:
            return False
        number, rows = int(request["number"]), self._memory.rows[int(request["block"]) % 2]
        self._served = number
        if self._unwanted(number):
            return True
        answer = self._plan(request, len(rows))
        if self._unwanted(number):
            return True
        header = self._header
        if isinstance(answer, PlanFailure):
            header["code"] = answer.code
            write_message(header, answer.message)
        else:
            trajectory = answer.trajectory
            used = rows[: trajectory.ticks]
            used[:, 0], used[:, 1], used[:, 2] = trajectory.position, trajectory.velocity, trajectory.acceleration
            header["code"], header["rows"], header["target"] = ResultCode.SUCCEEDED, trajectory.ticks, answer.target
            self.newest = trajectory
        fence()
        self._answered[0] = number
        return True

    def _take(self) -> Any:
        """Return a copy of the newest request; None if it was served, or is being written."""
        guard = self._guard.item()
        if guard == self._seen_guard or guard % 2:
            return None
        fence()
        request = self._header["request"].copy()
        fence()
        if self._guard.item() != guard:
            return None
        self._seen_guard = guard
        return request if request["number"] != self._served else None

    def _unwanted(self, number: int) -> bool:
        return self._dropped.item() >= number

    def _plan(self, request: Any, capacity: int) -> Plan | PlanFailure:
        try:
            opening = float(request["opening"]) if request["has_opening"] else None
            position, velocity, acceleration = request["state"]
            *ends, radius = request["held"].tolist()
            held = Capsule(HELD, self._planner.dof, tuple(ends[:3]), tuple(ends[3:]), radius) if radius else None
            # The name is the cerebellum's business, and may be longer than a record's.
            command = replace(decode_goal(request["goal"]), task_id=f"request {request['number']}")
            plan = self._planner.plan(command, position, velocity, acceleration, opening=opening, held=held)
        except Exception as error:
            # The arm waits for an answer, and the next goals for a planner.
            _LOG.exception("The planner failed.")
            return PlanFailure(ResultCode.PLANNING_FAILED, f"The planner failed with {type(error).__name__}: {error}")
        if isinstance(plan, Plan) and plan.trajectory.ticks > capacity:
            return PlanFailure(
                ResultCode.PLANNING_FAILED,
                f"The motion would take {plan.trajectory.ticks / self._planner.hz:.0f} s; there is room for "
                f"{capacity / self._planner.hz:.0f} s. Give it more speed or more acceleration.",
            )
        return plan
