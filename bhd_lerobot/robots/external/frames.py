"""The thread that calls another package's robot, on an absolute grid of frames."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import NANOSECONDS, Mode, Watchdog
from bhd_lerobot.errors import RealtimeError, as_text
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.device import Device, Reading
from bhd_lerobot.robots.external.gate import Gate

Vector = NDArray[np.float64]
_POLL_S = 0.05  # between two looks for an emergency stop while no episode runs


@dataclass
class DeviceFrame:
    """A frame: what was observed at its start and, once it is over, what was sent in it.

    Attributes:
        number: on the grid of its episode.
        due_ns: when it was due, monotonic [ns].
        started_ns: when it began.
        requested: the brain's last action by its end, shape (actions,).
        applied: what the robot said that it applied last, likewise.
        limits: `Limit` flags of the gate.
        watchdog: `Watchdog` flags.
        mode: the `Mode` at its end.
        command_age_ns: age of the brain's last action at its end [ns].
        skipped: frames of the grid before it that were left out.
        worked_ns: when the last call of the robot in it had returned.
        ended_ns: when it was over; 0 if it is not.
    """

    number: int
    due_ns: int
    started_ns: int
    reading: Reading
    requested: Vector
    applied: Vector
    limits: int = 0
    watchdog: int = 0
    mode: int = Mode.HOLD
    command_age_ns: int = 0
    skipped: int = 0
    worked_ns: int = 0
    ended_ns: int = 0


class FrameThread:
    """Observes at the start of every frame, and sends the brain's action as soon as it is there.

    The brain is not waited for: without an action the robot keeps the last one, after `brain_timeout_s` it holds, after
    `end_timeout_s` there is a fault. Every call of the robot is made on this thread; those who wait notice one that
    does not return.

    Args:
        device: the robot.
        gate: what every action goes through.
        fps: frames a second [Hz].
        config: the time-outs.

    Attributes:
        statistics: how punctual the frames of the present episode are.
        problem: why the last fault was, as text.
        is_estopped: whether the emergency stop is pressed; it latches.
    """

    def __init__(self, device: Device, gate: Gate, fps: int, config: GateConfig) -> None:
        self._device, self._gate, self._config = device, gate, config
        self.period_ns = NANOSECONDS // fps
        self.statistics = TimingStatistics(self.period_ns)
        self.problem = ""
        self.is_estopped = False
        self._changed = threading.Condition()
        self._frames: list[DeviceFrame] = []  # of the present episode, from the one that was taken last
        self._command: tuple[Vector, int] | None = None  # an action that was not sent yet, and when it came
        self._takes = False  # whether the present frame still sends what comes
        self._active = self._ended = self._idle = False
        self._came_ns = 0  # when the brain's last action came
        self._is_stopped = False  # whether the action of the emergency stop was sent: it is the last
        self._is_driven = gate.has_speeds  # whether there is anything to stop: an action was sent
        self._holds = False  # whether what holds a robot without a brain was sent, since the last action
        self._call = ("", 0)  # the call of the robot that is under way, and since when
        self._has_faulted = False
        self.origin_ns = 0
        self._thread = threading.Thread(target=self._run, name=f"bhd-{device.name}", daemon=True)
        self._thread.start()

    # --- from the brain's thread --------------------------------------------------------------------------------------

    def begin(self) -> DeviceFrame:
        """Begin an episode; return its first frame.

        Raises:
            RealtimeError: the robot cannot be observed.
        """
        with self._changed:
            if self._has_faulted:
                raise RealtimeError(f"The robot is in a fault: {self.problem}. Clear its cause and start again.")
            self._frames, self._command, self._active = [], None, True
            self.statistics.reset()
            self.origin_ns = time.monotonic_ns()
            self._changed.notify_all()
            self._wait(lambda: bool(self._frames))
            if not self._frames:
                raise RealtimeError(f"The robot cannot be observed: {self.problem}.")
            return self._frames[0]

    def act(self, action: Vector | None, seen: DeviceFrame) -> list[DeviceFrame]:
        """Send an action, and wait for the next frame.

        Args:
            action: shape (actions,); the last one stays if None.
            seen: the frame whose observation led to it.

        Returns:
            All frames from `seen` to the one in which the action was sent, and the one after it; after a fault or an
            emergency stop without the latter.
        """
        with self._changed:
            present = self._frames[-1].number
            wanted = present + 1 if self._takes or not self._active else present + 2
            if action is not None:
                self._command = (action.copy(), time.monotonic_ns())
                self._changed.notify_all()
            self._wait(lambda: self._frames[-1].number >= wanted)
            frames = [frame for frame in self._frames if frame.number >= seen.number]
            del self._frames[:-1]
            if self._has_faulted:
                return [*frames[:-1], self._faulted(frames[-1])]
            return frames

    def _faulted(self, frame: DeviceFrame) -> DeviceFrame:
        frame.mode = Mode.FAULT
        frame.watchdog |= Watchdog.PLANT
        frame.ended_ns = frame.ended_ns or time.monotonic_ns()
        return frame

    def newest(self) -> DeviceFrame:
        """Return the newest frame."""
        with self._changed:
            return self._frames[-1]

    def pause(self) -> None:
        """End the episode: nothing is observed or sent any more."""
        with self._changed:
            self._active = False
            self._changed.notify_all()
            self._wait(lambda: self._idle)

    def estop(self) -> None:
        """Latch the emergency stop: the robot holds where it is, and takes no further action. From any thread."""
        self.is_estopped = True
        if self._changed.acquire(blocking=False):  # otherwise it is seen at the next turn
            self._changed.notify_all()
            self._changed.release()

    def close(self) -> bool:
        """End the thread; return whether it has ended."""
        with self._changed:
            self._active, self._ended = False, True
            self._changed.notify_all()
        self._thread.join(self._config.call_timeout_s)
        return not self._thread.is_alive()

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until something is so, or there is a fault; a call of the robot that does not return is one."""
        while not (done() or self._has_faulted):
            self._changed.wait(0.02)
            name, since = self._call
            late = (time.monotonic_ns() - since) / NANOSECONDS
            if name and late > self._config.call_timeout_s and not done():
                self._fault(f"{name} of {self._device.name} has not returned for {late:.1f} s")

    def _fault(self, problem: str) -> None:
        if not self._has_faulted:
            self.problem = problem
        self._has_faulted, self._active = True, False
        self._changed.notify_all()

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                self._idle = True
                self._changed.notify_all()
                while not (self._active or self._ended or self._is_to_stop):
                    self._changed.wait(_POLL_S)
                if self._ended and not self._is_to_stop:
                    return
                self._idle = False
            try:
                if self._active:
                    self._episode()
                if self._is_to_stop:  # it may still be on its way to the last position
                    self._hold(self._called("get_observation", self._device.observe))
                elif self._gate.has_speeds:  # which would go on: positions stay by themselves
                    self._hold()
            except Exception as error:  # of another package's code
                words = as_text(error)
                text = str(error) if isinstance(error, RealtimeError) else f"{self._call[0]} raised {words}"
                with self._changed:
                    self._call = ("", 0)
                    self._fault(text)
                try:
                    self._hold()
                except Exception:  # the fault that is known already is the one that counts
                    self._call = ("", 0)

    def _episode(self) -> None:
        number, due, skipped = 0, self.origin_ns, 0
        last: DeviceFrame | None = None
        self._came_ns = self.origin_ns
        self._called("begin_episode", self._device.begin_episode)
        while not self._is_over():  # then the robot holds at once, not after another observation
            self._sleep_until(due)
            started = time.monotonic_ns()
            reading = self._called("get_observation", self._device.observe)
            if last is None:
                self._gate.begin(self._device.measured(reading.state))
                holding = self._gate.holding()
                last = DeviceFrame(-1, due, started, reading, holding, holding)
            frame = DeviceFrame(
                number, due, started, reading, last.requested, last.applied, mode=last.mode, skipped=skipped
            )
            with self._changed:
                if self._is_over():
                    return
                self._frames.append(frame)
                self._takes = True
                self._changed.notify_all()
            worked = time.monotonic_ns()
            while (action := self._next(frame, due + self.period_ns)) is not None:
                self._send(frame, action)
                before, worked = worked, time.monotonic_ns()
                self._is_stopped |= frame.mode == Mode.ESTOP
                if self._is_to_stop and worked - before > self.period_ns:
                    break  # pressed during a long call: where the robot is now is to be observed first
            now = frame.ended_ns = time.monotonic_ns()
            frame.worked_ns, frame.command_age_ns = worked, now - self._came_ns
            self.statistics.add(due, started, worked, skipped)
            skipped = max(0, (now - due) // self.period_ns - 1)
            number, due, last = number + 1 + skipped, due + (1 + skipped) * self.period_ns, frame

    def _is_over(self) -> bool:
        return not self._active

    @property
    def _is_to_stop(self) -> bool:
        """Whether the emergency stop is pressed and its action was not sent yet, to a robot that was driven."""
        return self.is_estopped and not self._is_stopped and self._is_driven and bool(self.origin_ns)

    def _next(self, frame: DeviceFrame, end_ns: int) -> Vector | None:
        """Wait for what is to be sent next in a frame, shape (actions,); None when the frame is over."""
        config = self._config
        with self._changed:
            while True:
                now = time.monotonic_ns()
                silent = (now - self._came_ns) / NANOSECONDS
                if self.is_estopped:
                    self._command, frame.mode = None, Mode.ESTOP
                    if self._is_to_stop:
                        return self._gate.stop(self._device.measured(frame.reading.state))
                elif self._command is not None and self._active:  # after a fault nothing more is sent
                    (requested, self._came_ns), self._command = self._command, None
                    frame.mode, self._holds = Mode.TRACKING, False
                    passed = self._gate.passed(requested)
                    frame.limits |= passed.limits
                    # What is not finite cannot be learned from: it is flagged, and what was sent is recorded instead.
                    frame.requested = np.where(np.isfinite(requested), requested, passed.action)
                    return passed.action
                elif silent > config.end_timeout_s:
                    raise RealtimeError(f"the brain has given no action for {silent:.1f} s")
                elif silent > config.brain_timeout_s and not frame.watchdog & Watchdog.COMMAND_AGE:
                    frame.mode = Mode.HOLD
                    frame.watchdog |= Watchdog.COMMAND_AGE
                    if self._is_driven and not self._holds:
                        self._holds = True  # once: a robot that goes a bounded step to what it is sent would go on
                        return self._gate.hold()
                if now >= end_ns or not self._active:
                    self._takes = False
                    return None
                until_silent = config.brain_timeout_s - silent
                left = (end_ns - now) / NANOSECONDS
                self._changed.wait(min(left, until_silent) if until_silent > 0 else left)

    def _send(self, frame: DeviceFrame, action: Vector) -> None:
        if not np.isfinite(action).all():
            return  # it is not known where the robot is, so it gets nothing
        self._is_driven = True
        frame.applied = self._called("send_action", lambda: self._device.send(action))

    def _hold(self, reading: Reading | None = None) -> None:
        """Send what the robot is left with: after an emergency stop where it was measured, and once.

        Without a reading a call has failed, that of the emergency stop's action perhaps: it is tried once more.
        """
        if self._is_stopped or not self._is_driven:
            return
        is_last = self.is_estopped
        self._is_stopped = is_last and reading is None
        action = self._gate.holding() if reading is None else self._gate.stop(self._device.measured(reading.state))
        if np.isfinite(action).all():
            self._called("send_action", lambda: self._device.send(action))
        self._is_stopped |= is_last

    def _called[T](self, name: str, call: Callable[[], T]) -> T:
        self._call = (name, time.monotonic_ns())
        result = call()
        self._call = ("", 0)
        return result

    @staticmethod
    def _sleep_until(due_ns: int) -> None:
        left = due_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left / NANOSECONDS)
