"""The bridge between brain and cerebellum on the wall clock, over shared memory."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.bridge import Bridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.messages import CerebellumState, Reason, Request, SendResult
from bhd_lerobot.control.motion.goal_codec import decode_feedback
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Word
from bhd_lerobot.realtime.requests import RequestClient


class LiveBridge(Bridge):
    """Sends commands to a cerebellum that ticks in another process, and reads what it publishes.

    Sending never waits. What the cerebellum finds out later (a command that became stale, a mode that changed) it
    counts in the refusals that it publishes. For one thread at a time.

    Args:
        block: what both processes share.
        cerebellum: one like that of the other process; it holds the record of that one, and its queue and word of the
            emergency stop are the shared ones. It never ticks.
        rates: the rates.
        wait: waits for about a tick, and raises if there is nothing to wait for any more.
        clock: monotonic time [ns].
    """

    def __init__(
        self,
        block: LiveBlock,
        cerebellum: Cerebellum,
        rates: Rates,
        wait: Callable[[], None],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(cerebellum, rates)
        cerebellum.fifo, cerebellum.estop = block.fifo, block.estop
        self._block, self._wait, self._clock = block, wait, clock
        self._client = RequestClient(block.requests, block.events, wait, clock_ns=clock)

    @property
    def now_ns(self) -> int:
        """Time of the cerebellum: since its tick 0 was due [ns]."""
        return self._clock() - int(self._block.words[Word.START])

    @property
    def latest(self) -> Any:
        """What was published last, a record of the block's dtype.

        Raises:
            RealtimeError: nothing has been published yet.
        """
        row = self._block.ring.latest()
        if row is None:
            raise RealtimeError("The real-time process has published nothing yet.")
        return row

    def show(self, row: Any) -> None:
        """Let the cerebellum hold what was published."""
        self.cerebellum.states[0], self.cerebellum.now_ns = row["state"], int(row["now_ns"])

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget what was sent in another segment."""
        self._forget()
        self._client.take_results()

    def _forget(self) -> None:
        self.cerebellum.fifo.sent_due_ns[:] = np.iinfo(np.int64).min

    def send(
        self,
        values: NDArray[np.float64],
        mask: NDArray[np.bool_] | None = None,
        due_ns: int | None = None,
        *,
        replaces: bool = False,
    ) -> SendResult:
        """Send one setpoint, see `Bridge.send`."""
        self.show(self.latest)
        return super().send(values, mask, due_ns, replaces=replaces)

    def submit(self, command: BrainCommand, sim: int = 0) -> CommandResult | None:
        """Send a goal, see `Bridge.submit`."""
        self._only(sim)
        return self._client.submit(command)

    def cancel(self, task_id: str, sim: int = 0) -> ResultCode:
        """Cancel a goal, see `Bridge.cancel`.

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
        return decode_feedback(self.latest["feedback"])

    def state(self) -> CerebellumState:
        """Return the newest state."""
        return self.reported(self.latest)

    def reported(self, row: Any) -> CerebellumState:
        """Return the state that was published."""
        self.show(row)
        return self.cerebellum.state(self.cerebellum.now_ns)

    def request(self, request: Request, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Request a change of mode, and wait until it is published.

        Raises:
            RealtimeError: the cerebellum does not answer.
        """
        reason = self._client.request(request, int(self._block.estop.latched[0]))
        if request == Request.ACTIVATE and reason == Reason.ACCEPTED:
            self._forget()  # what still waited was dropped
        # What was published before the request was carried out would still refuse what comes next.
        tick = int(self.latest["tick"])
        while int(self.latest["tick"]) <= tick:
            self._wait()
        return SendResult(np.array([reason], np.int8))

    @staticmethod
    def _only(sim: int) -> None:
        if sim != 0:
            raise ConfigError(f"sim is {sim}; on the wall clock there is one robot, number 0.")
