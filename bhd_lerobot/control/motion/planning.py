"""Requests for plans: answered at once, or later by a planner that works while the arm moves."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bhd_lerobot.bodies.body import Capsule
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.control.motion.trajectory import PlanFailure, State
from bhd_lerobot.errors import ConfigError

LEAD_S = 0.025  # [s] after a request its plan is to start
MIN_LEAD = 5  # ticks; less would be a matter of luck at any rate
MOST_LEADS = 16  # a planner that needs more than so many first leads is too slow for an arm that moves
TIMEOUT_S = 2.0  # [s] that an answer may take


class Planning(Protocol):
    """Plans goals, at once or later.

    At most one request for each arm is out. None of the methods ever waits.

    Attributes:
        lead: ticks from a request to the tick that its plan is to start at; 0 if it is answered at once.
        timeout: ticks that an answer may take.
    """

    lead: int
    timeout: int

    def request(  # noqa: PLR0917
        self,
        sim: int,
        command: BrainCommand,
        state: State,
        opening: float | None,
        start_tick: int,
        held: Capsule | None = None,
    ) -> None:
        """Request a plan; an earlier request is dropped.

        Args:
            state: where the plan is to start [rad, and m for the gripper], each of shape (dof + 1,).
            opening: where the gripper is commanded to [m], for goals that leave it as it is; None: where it is.
            start_tick: the tick that the plan is to start at.
            held: what is in the gripper.
        """

    def poll(self, sim: int) -> Plan | PlanFailure | None:
        """Return the answer to the last request, once; None if there is none yet."""

    def begin(self, sim: int) -> None:
        """Take note that the plan that was polled last is being played: its rows must stay as they are."""

    def drop(self, sim: int) -> None:
        """Drop the request: no answer is returned any more."""


class InlinePlanning:
    """Plans at the request: the answer is there in the same tick."""

    def __init__(self, planner: GoalPlanner) -> None:
        self.lead = self.timeout = 0
        self._planner = planner
        self._answers: dict[int, Plan | PlanFailure] = {}

    def request(  # noqa: PLR0917
        self,
        sim: int,
        command: BrainCommand,
        state: State,
        opening: float | None,
        start_tick: int,
        held: Capsule | None = None,
    ) -> None:
        """Plan."""
        reference = state.position, state.velocity, state.acceleration
        self._answers[sim] = self._planner.plan(command, *reference, opening=opening, held=held)

    def poll(self, sim: int) -> Plan | PlanFailure | None:
        """Return the plan."""
        return self._answers.pop(sim, None)

    def begin(self, sim: int) -> None:
        """Do nothing: the plan has no other owner."""

    def drop(self, sim: int) -> None:
        """Forget the plan."""
        self._answers.pop(sim, None)


def lead_ticks(control_hz: int, lead_s: float = LEAD_S) -> int:
    """Return a lead in ticks, at least `MIN_LEAD`.

    Raises:
        ConfigError: it is not positive and finite.
    """
    if not (math.isfinite(lead_s) and lead_s > 0):
        raise ConfigError(f"The planner's lead is {lead_s!r} s; it must be a positive number, such as {LEAD_S}.")
    return max(MIN_LEAD, math.ceil(lead_s * control_hz - 1e-6))


@dataclass
class _Order:
    """A plan that was requested and is not played yet."""

    command: BrainCommand
    state: State
    sent_tick: int
    lead: int
    answer: Plan | PlanFailure | None = None
    arrived_tick: int = 0


class PlanOrders:
    """The open requests for plans of n arms, at most one each.

    A plan is used only from the state that it was made for. For an arm that moves that is one tick: the one that lies
    a lead after the request. If the answer is later, it is requested again, from further ahead. An arm that is at rest
    stays where it is, and its plan is never too late.

    Args:
        control_hz: ticks a second [Hz].
    """

    def __init__(self, n: int, planning: Planning, control_hz: int) -> None:
        self.tick = 0
        self._planning, self._hz = planning, control_hz
        self._orders: list[_Order | None] = [None] * n

    @property
    def deferred(self) -> bool:
        """Whether plans come later than their requests."""
        return self._planning.lead > 0

    def wanted(self, sim: int) -> BrainCommand | None:
        """Return the goal that an arm waits for the plan of, or None."""
        order = self._orders[sim]
        return None if order is None else order.command

    def drop(self, sim: int) -> None:
        """Drop the request of an arm: an answer that comes later is ignored."""
        if self._orders[sim] is not None:
            self._orders[sim] = None
            self._planning.drop(sim)

    def ask(  # noqa: PLR0917
        self,
        sim: int,
        command: BrainCommand,
        now: State,
        ahead: Callable[[int], State],
        opening: float | None,
        held: Capsule | None = None,
    ) -> Plan | PlanFailure | None:
        """Return the plan of a goal when it is to start, or why there is none; None as long as it is too early.

        To be called every tick until the answer is there.

        Args:
            command: the goal; the same one as long as the arm waits for its plan.
            opening: where the gripper is commanded to [m]; None: where it is.
        """

        def order_for(lead: int) -> _Order:
            self._orders[sim] = order = _Order(command, ahead(lead), self.tick, lead)
            self._planning.request(sim, command, order.state, opening, self.tick + lead, held)
            return order

        order = self._orders[sim]
        if order is None:
            order = order_for(self._planning.lead)
        if order.answer is None:
            order.answer = self._planning.poll(sim)
            order.arrived_tick = self.tick
        answer = order.answer
        if answer is None:
            waited = self.tick - order.sent_tick
            return None if waited <= self._planning.timeout else self._give_up(sim, self._silence(waited))
        if isinstance(answer, PlanFailure):
            self._orders[sim] = None
            return answer
        if self.tick < order.sent_tick + order.lead:
            return None
        if not order.lead or _same(order.state, now):
            self._orders[sim] = None
            self._planning.begin(sim)
            return answer
        if order.lead >= MOST_LEADS * self._planning.lead:
            return self._give_up(sim, self._slowness(order))
        order_for(2 * order.lead)
        return None

    def _give_up(self, sim: int, message: str) -> PlanFailure:
        self.drop(sim)
        return PlanFailure(ResultCode.PLANNING_FAILED, message)

    def _silence(self, ticks: int) -> str:
        return (
            f"The planner did not answer within {ticks / self._hz:.3g} s: the process that plans is not running, is "
            "stopped or is overloaded. See to it, then send the goal again."
        )

    def _slowness(self, order: _Order) -> str:
        took, lead = order.arrived_tick - order.sent_tick, order.lead
        return (
            f"The planner's last answer took {took / self._hz:.3g} s, but the arm moves, and the plan was to start "
            f"after {lead / self._hz:.3g} s, the most. Relieve the process that plans, or send the goal when the arm "
            "is at rest."
        )


def _same(first: State, second: State) -> bool:
    # Counting is several times cheaper than `np.array_equal`.
    return not (
        np.count_nonzero(first.position != second.position)
        or np.count_nonzero(first.velocity != second.velocity)
        or np.count_nonzero(first.acceleration != second.acceleration)
    )
