"""The bridge between brain and cerebellum on the wall clock: the calls of `LockstepBridge`, over shared memory."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.bridge import Bridge
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.messages import (
    HORIZON_NS,
    NANOSECONDS,
    CerebellumState,
    Mode,
    Reason,
    Request,
    SendResult,
    mode_reason,
)
from bhd_lerobot.control.motion.goal_codec import decode_feedback
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Word
from bhd_lerobot.realtime.requests import RequestClient

_NEVER_NS = -(1 << 62)  # before every due time


class LiveBridge(Bridge):
    """Sends commands to a cerebellum that ticks in another process, and reads what it publishes.

    Sending never waits. What the cerebellum finds out later (a command that became stale, a mode that changed) it
    counts in the refusals that it publishes. For one thread at a time.

    Args:
        block: what both processes share.
        rates: the rates.
        client: sends requests for modes and goals.
        wait: waits for about a tick, and raises if there is nothing to wait for any more.
        clock: monotonic time [ns].
    """

    def __init__(
        self,
        block: LiveBlock,
        rates: Rates,
        client: RequestClient,
        wait: Callable[[], None],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.rates, self._wait, self._clock = rates, wait, clock
        self._block, self._client = block, client
        # After whatever was sent by another bridge: the cerebellum takes no sequence number twice.
        self._sequence, self._last_due = block.fifo.pushed, _NEVER_NS
        self._all = np.ones(1, np.bool_)

    @property
    def now_ns(self) -> int:
        """Time of the cerebellum: since its tick 0 was due [ns]."""
        return self._clock() - int(self._block.words[Word.START])

    @property
    def latest(self) -> Any:
        """The newest published state, a record of the block's dtype.

        Raises:
            RealtimeError: nothing has been published yet.
        """
        state = self._block.ring.latest()
        if state is None:
            raise RealtimeError("The real-time process has published nothing yet.")
        return state

    def begin(self) -> None:
        """Forget what was sent in another segment."""
        self._last_due = _NEVER_NS
        self._client.take_results()

    # --- setpoints ---------------------------------------------------------------------------------------------------

    def send(
        self,
        values: NDArray[np.float64],
        mask: NDArray[np.bool_] | None = None,
        due_ns: int | None = None,
        *,
        replaces: bool = False,
    ) -> SendResult:
        """Send one setpoint, see `Bridge.send`."""
        if mask is not None and not mask[0]:
            return SendResult(np.zeros(1, np.int8))
        due = self.now_ns if due_ns is None else due_ns
        reason = self._refusal(values, due, replaces)
        if reason == Reason.ACCEPTED:
            if self._block.fifo.push(self._sequence + 1, due, values, self._all):
                self._sequence, self._last_due = self._sequence + 1, due
            else:
                reason = Reason.FIFO_FULL
        return SendResult(np.array([reason], np.int8))

    def _refusal(self, values: NDArray[np.float64], due_ns: int, replaces: bool) -> Reason:
        if np.shape(values) != (1, self._block.fifo.width) or np.asarray(values).dtype.kind not in "fiu":
            return Reason.WRONG_WIDTH
        if self.estop_pressed:
            return Reason.ESTOP
        reason = mode_reason(Mode(int(self.latest["mode"][0])))
        if reason != Reason.ACCEPTED:
            return reason
        now = self.now_ns
        if abs(due_ns - now) > HORIZON_NS:
            return Reason.BEYOND_HORIZON if due_ns > now else Reason.STALE
        if due_ns < self._last_due and not replaces:
            return Reason.OUT_OF_ORDER
        return Reason.ACCEPTED if np.isfinite(values).all() else Reason.NON_FINITE

    def send_chunk(
        self, values: NDArray[np.float64], mask: NDArray[np.bool_] | None = None, start_ns: int | None = None
    ) -> list[SendResult]:
        """Send an action chunk, see `Bridge.send_chunk`."""
        now = self.now_ns
        start = now if start_ns is None else start_ns
        frame = NANOSECONDS // self.rates.fps
        results: list[SendResult] = []
        for k, row in enumerate(values):
            if start + (k + 1) * frame > now:
                results.append(self.send(row, mask, max(now, start + k * frame), replaces=not results))
        return results

    # --- goals -------------------------------------------------------------------------------------------------------

    def submit(self, command: BrainCommand, sim: int = 0) -> CommandResult | None:
        """Send a goal; None if it was accepted (its one result comes later), otherwise the refusal.

        Raises:
            ConfigError: there is one robot, number 0.
            RealtimeError: the cerebellum does not answer.
        """
        self._only(sim)
        return self._client.submit(command)

    def cancel(self, task_id: str, sim: int = 0) -> ResultCode:
        """Cancel a goal: decelerate, then hold. Return `SUCCEEDED`, or `UNKNOWN_ID` if there is no such goal.

        Raises:
            ConfigError: there is one robot, number 0.
            RealtimeError: the cerebellum does not answer.
        """
        self._only(sim)
        return self._client.cancel(task_id)

    def take_results(self, sim: int = 0) -> list[CommandResult]:
        """Return the results of goals that were not taken yet, in the order in which they came."""
        self._only(sim)
        return self._client.take_results()

    def feedback(self, sim: int = 0) -> Feedback | None:
        """Return how far the goal was that the robot followed at the start of the present frame, or None."""
        self._only(sim)
        state = self.latest
        return decode_feedback(state["feedback"]) if "feedback" in state.dtype.names else None

    # --- modes -------------------------------------------------------------------------------------------------------

    def state(self) -> CerebellumState:
        """Return the newest state."""
        state = self.latest
        start = int(self._block.words[Word.START])
        names = [name for name in CerebellumState.__dataclass_fields__ if name != "stamp_ns"]
        return CerebellumState(stamp_ns=int(state["due_ns"]) - start, **{name: state[name].copy() for name in names})

    def estop(self, ids: NDArray[np.intp] | None = None) -> None:
        """Press the emergency stop; the next tick latches it."""
        self._block.estop.press()

    @property
    def estop_pressed(self) -> bool:
        """Whether the emergency stop is pressed, be it latched already or not."""
        return bool(self._block.estop.pressed[0])

    def request(self, request: Request, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Request a change of mode, and wait until it is published.

        Raises:
            RealtimeError: the cerebellum does not answer.
        """
        reason = self._client.request(request, int(self._block.estop.latched[0]))
        if request == Request.ACTIVATE and reason == Reason.ACCEPTED:
            self._last_due = _NEVER_NS  # what still waited was dropped
        # What was published before the request was carried out would still refuse what comes next.
        tick = int(self.latest["tick"])
        while int(self.latest["tick"]) <= tick:
            self._wait()
        return SendResult(np.array([reason], np.int8))

    @staticmethod
    def _only(sim: int) -> None:
        if sim != 0:
            raise ConfigError(f"sim is {sim}; on the wall clock there is one robot, number 0.")
