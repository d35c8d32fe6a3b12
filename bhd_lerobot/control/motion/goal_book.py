"""The goals of one arm and their outcome: which wait, which is followed, and the results."""

from collections import deque
from collections.abc import Callable

from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.motion.trajectory import PlanFailure

REASONS = {
    ResultCode.CANCELLED: "The arm is being stopped.",
    ResultCode.NOT_ACTIVE: "The arm is not active; call activate(), after a deactivation reset() and activate().",
    ResultCode.ESTOP: "The emergency stop is latched; clear its cause, then call reset() and activate().",
    ResultCode.FAULT: "A fault of the plant is latched; clear its cause, then call reset() and activate().",
}
"""What happened to an arm that takes no goals."""

NO_FAILURE = (ResultCode.SUCCEEDED, ResultCode.CANCELLED, ResultCode.PREEMPTED, ResultCode.REPLACED_BY_SETPOINT)
"""How a goal may end without anything being wrong."""

_CAPACITY = 8  # goals that may wait


class GoalBook:
    """Ensures that every goal ends in exactly one result.

    Attributes:
        followed: the goal that is followed, or None.
        cancelled: whether the goal that is followed is to end as soon as the arm is at rest.
    """

    def __init__(self) -> None:
        self.waiting: deque[BrainCommand] = deque()
        self.followed: BrainCommand | None = None
        self.cancelled = False
        self._results: list[CommandResult] = []

    def admit(
        self, command: BrainCommand, blocked: ResultCode | None, check: Callable[[BrainCommand], PlanFailure | None]
    ) -> CommandResult | None:
        """Let a goal wait, or refuse it.

        The refusal is its result, except for a goal that has the name of a live one: that one still gets its own.

        Args:
            command: the goal; one that preempts ends all others.
            blocked: why the arm takes no goals now; None if it does.
        """
        name = command.task_id
        if (self.followed is not None and self.followed.task_id == name) or self.find(name) is not None:
            message = f"The goal {name!r} has not ended yet; its task_id can be used again after that."
            return CommandResult(name, False, ResultCode.DUPLICATE_ID, message)
        failure = check(command) if blocked is None else PlanFailure(blocked, REASONS.get(blocked, blocked.name))
        if failure is None and not command.preempt and len(self.waiting) >= _CAPACITY:
            failure = PlanFailure(
                ResultCode.QUEUE_FULL, f"{_CAPACITY} goals wait already; send it later, or with preempt."
            )
        if failure is not None:
            return self.report(name, failure.code, failure.message)
        if command.preempt:
            self.end_all(ResultCode.PREEMPTED, f"The goal {name!r} took its place.")
        self.waiting.append(command)
        return None

    def find(self, task_id: str) -> BrainCommand | None:
        """Return the goal that waits and has this name, or None."""
        return next((command for command in self.waiting if command.task_id == task_id), None)

    def follow(self) -> BrainCommand:
        """Take the next goal out of the queue: from now on it is followed."""
        self.followed, self.cancelled = self.waiting.popleft(), False
        return self.followed

    def cancel(self, task_id: str) -> ResultCode:
        """End a goal that waits; mark one that is followed. SUCCEEDED, or UNKNOWN_ID."""
        command = self.find(task_id)
        if command is not None:
            self.waiting.remove(command)
            self.report(task_id, ResultCode.CANCELLED, "It was cancelled before it began.")
        elif self.followed is not None and self.followed.task_id == task_id:
            self.cancelled = True
        else:
            return ResultCode.UNKNOWN_ID
        return ResultCode.SUCCEEDED

    def end(self, code: ResultCode, message: str) -> bool:
        """End the goal that is followed; return whether there was one."""
        command, self.followed = self.followed, None
        if command is None:
            return False
        self.report(command.task_id, code, message)
        return True

    def end_all(self, code: ResultCode, message: str) -> bool:
        """End the goal that is followed and those that wait; return whether there was one."""
        ended = self.end(code, message) or bool(self.waiting)
        while self.waiting:
            self.report(self.waiting.popleft().task_id, code, message)
        return ended

    def report(self, task_id: str, code: ResultCode, message: str) -> CommandResult:
        """Write down a result."""
        result = CommandResult(task_id, code == ResultCode.SUCCEEDED, code, message)
        self._results.append(result)
        return result

    def take_results(self) -> list[CommandResult]:
        """Return the results that were not taken yet, in the order in which the goals ended."""
        results, self._results = self._results, []
        return results
