"""Goals of n arms: the queue, the state machine, and exactly one result for every goal."""

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, Capsule
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, GoalPhase, ResultCode
from bhd_lerobot.control.motion.goal_book import NO_FAILURE, REASONS, GoalBook
from bhd_lerobot.control.motion.planner import GoalPlanner
from bhd_lerobot.control.motion.planning import InlinePlanning, Planning, PlanOrders
from bhd_lerobot.control.motion.player import TrajectoryPlayer
from bhd_lerobot.control.motion.supervision import Verdict, begin_goal, explain_verdict
from bhd_lerobot.control.motion.trajectory import PlanFailure, State, Trajectory, eased

Array = NDArray[np.float64]
_CONVERTING, _EXECUTING = int(GoalPhase.CONVERTING), int(GoalPhase.EXECUTING)


class _Motion(IntEnum):
    """What the reference of a simulation follows."""

    NONE = 0
    GOAL = 1
    BRAKE = 2
    HARD_BRAKE = 3


class GoalManager:
    """Follows goals, one after the other, for each of n arms.

    A tick judges what is followed and plays it, see `judge_goal` and `play`; it comes here to start, to end and to
    brake: `serve`.

    Attributes:
        phase: a `GoalPhase` for each arm, shape (n,).
        busy: whether a goal is followed or waits, or a brake is played, shape (n,).
        following: whether a trajectory is what the reference follows, shape (n,).
        player: what is played.

    Args:
        states: the records of the robots.
        arms: the records of the arms.
        control_hz: ticks a second [Hz].
        planning: who plans; planned in the tick that a goal starts in if None.
    """

    def __init__(
        self, body: Body, states: NDArray[Any], arms: NDArray[Any], control_hz: int, planning: Planning | None = None
    ) -> None:
        self._arm, n = body.need(Arm), len(arms)
        self._hz, self._dof = control_hz, len(self._arm.chain.joints)
        width = len(self._arm.limits.names)
        self.planner = GoalPlanner(body, control_hz)
        self.phase: NDArray[np.int8] = np.full(n, GoalPhase.IDLE, np.int8)
        self.busy: NDArray[np.bool_] = states["busy"]
        self.following: NDArray[np.bool_] = arms["follows"]
        self.player = TrajectoryPlayer(arms, width)
        self._states, self._arms, self._follows = states, arms, states["follows_goal"]
        self._reference = states["command"][:, :width], arms["speed"][:, :width], arms["change"][:, :width]
        self._orders = PlanOrders(n, InlinePlanning(self.planner) if planning is None else planning, control_hz)
        self._books = [GoalBook() for _ in range(n)]
        self._opening: list[float | None] = [None] * n  # where the gripper is commanded to [m]; None: where it is
        self._held: list[Capsule | None] = [None] * n
        self._planned = np.ones(n, np.int64)  # ticks of the trajectory of the goal that is followed
        self._motion = np.full(n, _Motion.NONE, np.int8)
        self._setpoint_jerk = np.asarray(self._arm.limits.setpoint_jerk)

    # --- requests of a brain -----------------------------------------------------------------------------------------

    def submit(self, sim: int, command: BrainCommand, blocked: ResultCode | None = None) -> CommandResult | None:
        """Take a goal, see `Controller.submit`; it starts as soon as it is planned.

        A refusal is also among the results, except for a goal that has the name of one that is followed or waits: that
        one still gets its own. A name counts as used even if its goal was refused.
        """
        book = self._books[sim]
        refusal = book.admit(command, blocked, self.planner.check)
        if refusal is None:
            if book.followed is None:
                self.phase[sim] = GoalPhase.CONVERTING
            self._changed(sim)
        return refusal

    def cancel(self, sim: int, task_id: str) -> ResultCode:
        """Cancel a goal: one that waits ends at once, one that is followed when the arm has come to rest."""
        book = self._books[sim]
        code = book.cancel(task_id)
        if book.followed is None and not book.waiting and self.phase[sim] == GoalPhase.CONVERTING:
            self.phase[sim] = GoalPhase.IDLE
        self._changed(sim)
        return code

    def take_results(self, sim: int) -> list[CommandResult]:
        """Return the results that were not taken yet, in the order in which the goals ended."""
        return self._books[sim].take_results()

    def feedback(self, sim: int) -> Feedback | None:
        """Return how far the goal is that is followed, or that is next; None without a goal."""
        book, phase = self._books[sim], GoalPhase(int(self.phase[sim]))
        if book.followed is None:
            return Feedback(book.waiting[0].task_id, phase, 0.0, 0.0, 0.0) if book.waiting else None
        left = self.player.remaining(sim)
        error = float(self._arms["away"][sim].max())
        progress = 1.0 - min(1.0, left / int(self._planned[sim]))
        return Feedback(book.followed.task_id, phase, progress, left / self._hz, error)

    # --- requests of the controller ----------------------------------------------------------------------------------

    def hold(self, sim: int, held: Capsule | None) -> None:
        """Plan with something in an arm's gripper from now on; with nothing if None."""
        self._held[sim] = held

    def stop(self, sim: int, code: ResultCode, *, hard: bool, message: str = "") -> None:
        """End all goals of an arm at once, and brake from the next tick on.

        Args:
            sim: the arm.
            code: how its goals end.
            hard: whether to brake with the limits of a stop; a stop that has begun hard stays so.
            message: why; from the code if it is empty.
        """
        self._end_all(sim, code, message or REASONS.get(code, "The arm was stopped."))
        wanted = _Motion.HARD_BRAKE if hard else _Motion.BRAKE
        if self._motion[sim] < wanted:
            self._brake(sim, wanted)
        self._changed(sim)

    def end_all(self, sim: int, code: ResultCode, message: str) -> None:
        """End all goals of an arm, with a result and the reason, and let the owner have the reference as it is."""
        self._end_all(sim, code, message)
        self.let_go(sim)

    def let_go(self, sim: int) -> None:
        """Play nothing any more for an arm."""
        self._rest(sim)
        self._changed(sim)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about arms that were put somewhere else, results included."""
        for sim in np.asarray(ids).tolist():
            self._books[sim] = GoalBook()
            self._held[sim] = None
            self._rest(sim)
            self.phase[sim] = GoalPhase.IDLE
            self._changed(sim)

    def serve(self, sim: int) -> None:
        """Do in the middle of a tick what the arm's record asks for: end, brake, start what is next."""
        arm = self._arms[sim]
        self._orders.tick = int(arm["at_tick"])
        if verdict := int(arm["verdict"]):
            arm["verdict"] = Verdict.NONE
            self._end(sim, *explain_verdict(verdict, self._arm, self._states[sim], arm, self._hz))
            self._brake(sim, _Motion.BRAKE)
            self._changed(sim)
        if arm["brakes"] and not self.player.is_playing(sim):
            self._rest(sim)
            if self._books[sim].followed is not None:
                self._end(sim, ResultCode.CANCELLED, "It was cancelled; the arm has come to rest.")
            self._changed(sim)
        if arm["waits"]:
            if self._serve(sim):
                self._changed(sim)
            self._note_phase(sim)

    # --- the state machine -------------------------------------------------------------------------------------------

    def _serve(self, sim: int) -> bool:
        """Start the next goal of an arm, or the brake of one that was cancelled, as soon as it may."""
        book, motion = self._books[sim], self._motion[sim]
        if motion == _Motion.HARD_BRAKE:
            return False
        if book.followed is not None:
            self._brake(sim, _Motion.BRAKE)
            if self._motion[sim] == _Motion.NONE:
                self._end(sim, ResultCode.CANCELLED, "It was cancelled; the arm was at rest.")
        elif book.waiting and (motion != _Motion.BRAKE or book.waiting[0].preempt or self._orders.wanted(sim)):
            return self._prepare(sim, book)
        elif motion == _Motion.GOAL:
            # The goal that took the last one's place was cancelled before it began.
            self._brake(sim, _Motion.BRAKE)
        return True

    def _prepare(self, sim: int, book: GoalBook) -> bool:
        """Have the next goal planned, and start it; return whether it was started or has failed."""
        self.phase[sim] = GoalPhase.CONVERTING
        before, now = self._begin(sim)
        if self._orders.deferred and self._motion[sim] == _Motion.NONE and now.moving:
            # It has followed setpoints. Where it is going to be is known only after a stop.
            self._brake(sim, _Motion.BRAKE)
            self._changed(sim)

        def ahead(ticks: int) -> State:
            return (self.player.ahead(sim, ticks) if ticks else None) or State.of(*vars(now).values())

        command = book.waiting[0]
        plan = self._orders.ask(sim, command, now, ahead, self._opening[sim], self._held[sim])
        if plan is None:
            return False
        book.follow()
        if isinstance(plan, PlanFailure):
            self._end(sim, plan.code, plan.message)
            if self._motion[sim] < _Motion.BRAKE:
                self._brake(sim, _Motion.BRAKE)
            return True
        self._planned[sim] = plan.trajectory.ticks
        self._opening[sim] = float(plan.target[self._dof]) if self._arm.gripper else None
        if plan.rows is None:
            self.player.start(sim, plan.trajectory if before is None else before.then(plan.trajectory))
        else:
            self.player.borrow(plan.rows)
        begin_goal(self._arms[sim], command, plan.target, self._hz)
        self._motion[sim] = _Motion.GOAL
        self.phase[sim] = GoalPhase.EXECUTING
        return True

    def _brake(self, sim: int, motion: _Motion) -> None:
        """Brake an arm; one that is at rest stays there."""
        self._rest(sim)
        before, state = self._begin(sim)
        if state.moving:
            brake = self.planner.brake(state, hard=motion == _Motion.HARD_BRAKE)
            self.player.start(sim, brake if before is None else before.then(brake))
            self._motion[sim] = motion

    def _begin(self, sim: int) -> tuple[Trajectory | None, State]:
        """Return from where a motion of an arm begins, and what has to be played before."""
        state = State.of(*(array[sim] for array in self._reference))
        # Setpoints change accelerations faster than goals.
        return eased(state, self._setpoint_jerk, self._hz) if self._arms["has_left"][sim] else (None, state)

    def _rest(self, sim: int) -> None:
        self.player.stop(sim)
        self._motion[sim] = _Motion.NONE
        self._opening[sim] = None

    def _end(self, sim: int, code: ResultCode, message: str) -> None:
        if self._books[sim].end(code, message):
            self.phase[sim] = GoalPhase.IDLE if code in NO_FAILURE else GoalPhase.ERROR

    def _end_all(self, sim: int, code: ResultCode, message: str) -> None:
        if self._books[sim].end_all(code, message):
            self.phase[sim] = GoalPhase.IDLE if code in NO_FAILURE else GoalPhase.ERROR

    def _changed(self, sim: int) -> None:
        """Bring up to date what follows from the state of an arm."""
        book, motion = self._books[sim], self._motion[sim]
        followed, cancelled = book.followed is not None, book.cancelled
        if self._orders.wanted(sim) is not (book.waiting[0] if book.waiting else None):
            self._orders.drop(sim)
        on_the_way = motion == _Motion.GOAL
        arm = self._arms[sim]
        arm["is_judged"] = followed and on_the_way and not cancelled
        arm["brakes"] = motion >= _Motion.BRAKE
        arm["waits"] = (not followed and (bool(book.waiting) or on_the_way)) or (followed and cancelled and on_the_way)
        self.following[sim] = motion != _Motion.NONE
        self.busy[sim] = self.following[sim] or followed or bool(book.waiting)
        self._note_phase(sim)

    def _note_phase(self, sim: int) -> None:
        self._follows[sim] = self.phase[sim] in (_CONVERTING, _EXECUTING)
