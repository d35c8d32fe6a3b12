"""The bridge between brain and cerebellum, and that of a simulated clock."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.messages import HORIZON_NS, NANOSECONDS, CerebellumState, Reason, Request, SendResult, Setpoint
from bhd_lerobot.errors import ConfigError


class Bridge(ABC):
    """Sends commands to a cerebellum, and reads its state: in lockstep, or across processes on the wall clock.

    Args:
        cerebellum: the controller, or on the wall clock one that holds the record of the controller.
        rates: the rates.
    """

    def __init__(self, cerebellum: Cerebellum, rates: Rates) -> None:
        self.cerebellum, self.rates = cerebellum, rates

    @property
    @abstractmethod
    def now_ns(self) -> int:
        """Time of the cerebellum [ns]."""

    def send(
        self,
        values: NDArray[np.float64],
        mask: NDArray[np.bool_] | None = None,
        due_ns: int | None = None,
        *,
        replaces: bool = False,
    ) -> SendResult:
        """Send one setpoint.

        Args:
            values: the commands, shape (n, width).
            mask: the simulations it is for, shape (n,); all if None.
            due_ns: when it takes effect [ns]; at the next tick if None.
            replaces: whether it takes the place of what was sent before and is not due yet; one for now always does.
        """
        cerebellum, now = self.cerebellum, self.now_ns
        due = now if due_ns is None else due_ns
        if abs(due - now) > HORIZON_NS:
            return cerebellum.refuse(Reason.BEYOND_HORIZON if due > now else Reason.STALE, mask)
        sequence = int(cerebellum.fifo.sent_sequence.max()) + 1
        return cerebellum.offer(Setpoint(sequence, due, values, replaces or due_ns is None), mask)

    def send_chunk(
        self, values: NDArray[np.float64], mask: NDArray[np.bool_] | None = None, start_ns: int | None = None
    ) -> list[SendResult]:
        """Send an action chunk: several setpoints, one for each coming frame, in place of what is left of the last.

        Args:
            values: the commands, shape (frames, n, width).
            mask: the simulations it is for, shape (n,); all if None.
            start_ns: when the first takes effect [ns]; at the next tick if None. Those whose frame has gone by already
                are left out: a brain that took its time does not make the robot hurry.
        """
        now = self.now_ns
        start = now if start_ns is None else start_ns
        dues = [start + k * NANOSECONDS // self.rates.fps for k in range(len(values) + 1)]
        results: list[SendResult] = []
        for row, due, end in zip(values, dues, dues[1:], strict=False):
            if end > now:
                results.append(self.send(row, mask, max(now, due), replaces=not results))
        return results

    @abstractmethod
    def submit(self, command: BrainCommand, sim: int = 0) -> CommandResult | None:
        """Send a goal to one simulation; None if it was accepted (its one result comes later), otherwise the refusal.

        Raises:
            ConfigError: there is no such simulation.
            RealtimeError: the cerebellum does not answer.
        """

    @abstractmethod
    def cancel(self, task_id: str, sim: int = 0) -> ResultCode:
        """Cancel a goal: decelerate, then hold. Return `SUCCEEDED`, or `UNKNOWN_ID` if there is no such goal."""

    @abstractmethod
    def take_results(self, sim: int = 0) -> list[CommandResult]:
        """Return the results of one simulation's goals that were not taken yet, in the order in which they came."""

    @abstractmethod
    def feedback(self, sim: int = 0) -> Feedback | None:
        """Return how far the goal is that one simulation follows, or None."""

    @abstractmethod
    def state(self) -> CerebellumState:
        """Return a copy of the newest state."""

    def estop(self, ids: NDArray[np.intp] | None = None) -> None:
        """Press the emergency stop; the next tick latches it."""
        self.cerebellum.estop.press(ids)

    @property
    def estop_pressed(self) -> bool:
        """Whether the emergency stop of any simulation is pressed, be it latched already or not."""
        return bool(np.any(self.cerebellum.estop.pressed))

    @abstractmethod
    def request(self, request: Request, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Request a change of mode of some simulations, of all if None; return the outcome of it."""

    @abstractmethod
    def restart(self, ids: NDArray[np.intp]) -> None:
        """Start new episodes of robots that were put somewhere else."""

    def configure(self, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Leave UNCONFIGURED: odometry starts here."""
        return self.request(Request.CONFIGURE, ids)

    def activate(self, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Leave INACTIVE: setpoints are accepted from now on."""
        return self.request(Request.ACTIVATE, ids)

    def deactivate(self, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Ramp to rest and refuse setpoints."""
        return self.request(Request.DEACTIVATE, ids)

    def reset(self, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Clear an emergency stop, a fault or a deactivation; motion needs `activate` afterwards."""
        return self.request(Request.RESET, ids)


class LockstepBridge(Bridge):
    """Runs the cerebellum on simulated time: a command is sent, then exactly one frame of ticks goes by.

    Nothing waits and nothing is late: the same commands give the same states, bit for bit.

    Args:
        cerebellum: the controller.
        rates: the rates; `control_hz` is the cerebellum's.
        advance: moves the plant on by one tick; called after every tick.
        run: runs up to so many ticks from a number on, of cerebellum and plant; returns how many it ran, none if
            they are to be run one by one.

    Raises:
        ConfigError: a frame lasts longer than the command time-out, so that every command would time out; or the
            cerebellum was made for another rate.
    """

    def __init__(
        self,
        cerebellum: Cerebellum,
        rates: Rates,
        advance: Callable[[], None],
        run: Callable[[int, int], int] = lambda *_: 0,
    ) -> None:
        timeout = cerebellum.body.limits.command_timeout_s
        if 1.0 / rates.fps > timeout:
            raise ConfigError(
                f"At fps = {rates.fps} a command has to last {1.0 / rates.fps:g} s, longer than the command time-out "
                f"of {timeout:g} s. Raise fps to at least {int(np.ceil(1 / timeout))}."
            )
        if rates.control_hz != cerebellum.control_hz:
            raise ConfigError(
                f"control_hz is {rates.control_hz}, but the cerebellum was made for {cerebellum.control_hz} Hz."
            )
        super().__init__(cerebellum, rates)
        self._advance, self._run = advance, run
        self._tick = 0

    @property
    def now_ns(self) -> int:
        """Simulated time since the bridge was made [ns]."""
        return self._tick * NANOSECONDS // self.rates.control_hz

    # --- goals -------------------------------------------------------------------------------------------------------

    def submit(self, command: BrainCommand, sim: int = 0) -> CommandResult | None:
        """Send a goal to one simulation, see `Bridge.submit`."""
        if not 0 <= sim < self.cerebellum.n:
            raise ConfigError(f"sim is {sim}; there are {self.cerebellum.n} simulations, from 0 on.")
        return self.cerebellum.submit(sim, command)

    def cancel(self, task_id: str, sim: int = 0) -> ResultCode:
        """Cancel a goal: decelerate, then hold. Return `SUCCEEDED`, or `UNKNOWN_ID` if there is no such goal."""
        return self.cerebellum.controller.cancel(sim, task_id)

    def take_results(self, sim: int = 0) -> list[CommandResult]:
        """Return the results of one simulation's goals that were not taken yet, in the order in which they came."""
        return self.cerebellum.controller.take_results(sim)

    def feedback(self, sim: int = 0) -> Feedback | None:
        """Return how far the goal is that one simulation follows, or None."""
        return self.cerebellum.controller.feedback(sim)

    # --- time --------------------------------------------------------------------------------------------------------

    def advance_frame(self) -> None:
        """Let one frame go by."""
        self.advance_ticks(self.rates.ticks_per_frame)

    def advance_ticks(self, ticks: int) -> None:
        """Let some control ticks go by."""
        end = self._tick + ticks
        while self._tick < end:
            if done := self._run(self._tick, end - self._tick):
                self._tick += done
                continue
            self.cerebellum.tick(self.now_ns)
            self._tick += 1
            self._advance()

    def state(self) -> CerebellumState:
        """Return a copy of the present state."""
        return self.cerebellum.state(self.now_ns)

    def request(self, request: Request, ids: NDArray[np.intp] | None = None) -> SendResult:
        """Request a change of mode; it happens before the next tick or is refused with a reason."""
        return self.cerebellum.request(request, ids)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Start a new episode in simulations whose plant was put to a new initial state: configured and active."""
        self.cerebellum.restart(ids)
        self.configure(ids)
        self.activate(ids)
