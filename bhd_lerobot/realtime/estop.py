"""Emergency stops from outside of the program: a signal, a key of the terminal, a physical button."""

import contextlib
import math
import os
import select
import signal
import threading
from collections.abc import Callable
from functools import partial
from types import FrameType, TracebackType
from typing import Any, Protocol, Self

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.keys import KeySource, key_source

SIGNALS = ("SIGUSR1", "SIGUSR2", "SIGQUIT")
"""Signals that may stand for an emergency stop: those that mean nothing else to a run."""
KEYS = b" eE"
"""Keys of the terminal that press: space and e, also as a capital."""
POLL_S = 0.01  # [s] between two calls of a callable, by default
_ROUND_S = 0.05  # [s] between two rounds of the thread: how often what stays pressed is pressed again
_SILENCE_S = 1.0  # [s] a callable that has not answered for so long hangs


class HasDescriptor(Protocol):
    """A file, a socket, a serial port."""

    def fileno(self) -> int:
        """Return its file descriptor."""


Source = int | HasDescriptor | Callable[[], Any]
"""A physical button: a file descriptor, what has one, or a callable."""


def estop_signal(name: str) -> signal.Signals:
    """Return the signal of a name, ``SIGUSR1`` or ``usr1``.

    Raises:
        ConfigError: it does not exist, or means something else; the message lists the valid ones.
    """
    wanted = name.upper()
    wanted = wanted if wanted.startswith("SIG") else f"SIG{wanted}"
    if wanted not in SIGNALS:
        raise ConfigError(f"The signal for an emergency stop is {name!r}. Valid: {', '.join(SIGNALS)}.")
    return signal.Signals[wanted]


def check_source(source: Source, period_s: float = POLL_S) -> int | None:
    """Return the file descriptor of a button, or None for a callable.

    Raises:
        ConfigError: it is neither, the descriptor is not open, or the period is not positive.
    """
    if isinstance(source, int) or hasattr(source, "fileno"):
        try:
            descriptor = source if isinstance(source, int) else int(source.fileno())
            os.fstat(descriptor)
        except (OSError, ValueError, OverflowError) as error:
            raise ConfigError(f"The emergency stop's input {source!r} cannot be used: {error}.") from None
        return descriptor
    if not callable(source):
        raise ConfigError(
            f"An input of the emergency stop is {source!r}; give a file descriptor, an object with fileno(), "
            "or a callable that returns whether it is pressed."
        )
    if not 0 < period_s < math.inf:
        raise ConfigError(f"period_s is {period_s}; it must be positive and finite.")
    return None


class EstopInputs:
    """Inputs in the brain's process that press the emergency stop.

    A thread waits for all descriptors at once and each callable has a thread of its own, so that none holds up another.
    Each presses again for as long as it stays pressed: a reset does not help while a wire is cut.

    From the press to the call of `press`: a descriptor, a key or a signal takes one wake-up of a thread, a callable at
    most its period in addition. All of them need Python's interpreter lock: a brain that keeps it keeps them waiting,
    until the watchdog on the brain's process stops the robot. This is no certified safety function.

    Args:
        press: what presses: sets the word of the emergency stop. Called from any thread and from a signal handler, as
            often as it likes; must neither block nor raise. None: what comes until `attach` is kept for it.
        on_key: gets the terminal's keys that do not press, from the thread that waits for them; must not block either.

    Attributes:
        causes: what has pressed so far, as text, each once, in the order of the first time.
    """

    def __init__(
        self, press: Callable[[], None] | None = None, on_key: Callable[[bytes], None] = lambda keys: None
    ) -> None:
        self.causes: list[str] = []
        self._on_other_keys = on_key
        self._press_word = press
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._handlers: dict[int, Callable[[bytes], None]] = {}  # what handles the bytes of each descriptor
        self._broken: list[str] = []  # inputs that can press no more, and therefore stay pressed
        self._silence: dict[str, int] = {}  # rounds of the thread that a callable may still be silent for
        self._signals: dict[signal.Signals, Any] = {}
        self._pipe: tuple[int, int] | None = None  # signals arrive here even if the main thread is busy
        self._keys: KeySource | None = None
        self._poll = select.poll()
        self._waker, self._wake = os.pipe()
        self._poll.register(self._waker, select.POLLIN)

    def attach(self, press: Callable[[], None]) -> None:
        """Call this from now on, and at once if something has pressed already, while there was no robot."""
        self._press_word = press
        if self.causes:
            press()

    def cause(self, is_pressed: bool) -> str:
        """Return what an emergency stop came from, as text.

        Args:
            is_pressed: whether the word of the emergency stop is set, which the robot's own stop does not do.
        """
        return ", ".join(self.causes) or ("from another process" if is_pressed else "the robot's own")

    # --- inputs ------------------------------------------------------------------------------------------------------

    def add(self, source: Source, name: str = "", period_s: float = POLL_S) -> None:
        """Add a physical button.

        Args:
            source: a file descriptor or an object with one: any byte presses, and so does its end or an error, a wire
                that is cut. Or a callable, called once a period: it presses when it returns something true, raises, or
                does not return for a second. Neither is closed here.
            name: what it is called in `causes`.
            period_s: time between two calls of a callable [s].

        Raises:
            ConfigError: it is neither, the descriptor is not open, or the period is not positive.
        """
        descriptor = check_source(source, period_s)
        name = name or f"input {len(self._handlers) + len(self._silence)}"
        if descriptor is not None:
            self._watch(descriptor, partial(self._on_button, descriptor, name))
            return
        name = name if name not in self._silence else f"{name} ({len(self._silence)})"
        rounds = math.ceil((_SILENCE_S + period_s) / _ROUND_S)
        self._silence[name] = rounds
        self._run_thread(f"bhd-estop {name}", self._poll_callable, source, name, period_s, rounds)
        self._start()

    def add_key(self, descriptor: int | None = None) -> bool:
        """Let space and ``e`` in the terminal press; return whether there is a terminal to do so.

        A process that runs in the background leaves the terminal alone.

        Args:
            descriptor: of the terminal; standard input if None.
        """
        if self._keys is not None or (source := key_source(descriptor)) is None:
            return False
        self._keys = source
        source.subscribe(self._on_terminal_keys, first=True)
        return True

    def lend_keys(self) -> contextlib.AbstractContextManager[None]:
        """Give the terminal back meanwhile, to whoever asks a person in it; see `KeySource.lent`."""
        return contextlib.nullcontext() if self._keys is None else self._keys.lent()

    def add_signal(self, number: signal.Signals = signal.SIGUSR1) -> None:
        """Let a signal press. The former handler comes back with `close`.

        Where that was the system's, which ends the program, the signal is ignored then.

        Raises:
            ConfigError: this is not the main thread, the only one in which Python installs handlers.
        """
        thread = threading.current_thread()
        if thread is not threading.main_thread():
            raise ConfigError(
                f"{number.name} can be made an emergency stop in the main thread only; this is {thread.name!r}. "
                "Do it there, or call robot.estop() here."
            )
        if number in self._signals:
            return
        # A handler runs when the main thread comes back to Python; the pipe wakes the thread at once.
        if self._pipe is None:
            self._open_pipe()
        self._signals[number] = signal.signal(number, self._handle)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])  # blocked while a command starts

    def _open_pipe(self) -> None:
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        os.set_blocking(writer, False)
        former = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        if former != -1:  # another library's, an event loop's for example: only the handler is used
            signal.set_wakeup_fd(former, warn_on_full_buffer=False)
            os.close(reader)
            os.close(writer)
            return
        self._pipe = reader, writer
        self._watch(reader, self._on_signals)

    # --- pressing ----------------------------------------------------------------------------------------------------

    def press(self, cause: str) -> None:
        """Press, for a cause. From any thread."""
        if self._stop.is_set():
            return
        if cause not in self.causes:
            self.causes.append(cause)  # first: `attach` presses if there is one
        if self._press_word is not None:
            self._press_word()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.press(f"signal {signal.Signals(number).name}")

    def _on_signals(self, received: bytes) -> None:
        for number in received:
            if number in self._signals:
                self.press(f"signal {signal.Signals(number).name}")

    def _on_terminal_keys(self, keys: bytes) -> None:
        if any(key in keys for key in KEYS):
            self.press("key")
        self._on_other_keys(bytes(key for key in keys if key not in KEYS))

    def _on_button(self, descriptor: int, name: str, received: bytes) -> None:
        if received:
            self.press(name)
        else:
            self._poll.unregister(descriptor)
            self._broken.append(f"{name} is closed or broken")

    def _poll_callable(self, source: Callable[[], Any], name: str, period_s: float, rounds: int) -> None:
        """Call a callable again and again; the work of its thread."""
        while not self._stop.wait(period_s):
            try:
                if source():
                    self.press(name)
            except Exception as error:  # whatever it is: an input that fails cannot be relied on
                self.press(f"{name} failed: {type(error).__name__}: {error}")
            self._silence[name] = rounds

    def _watch(self, descriptor: int, handler: Callable[[bytes], None]) -> None:
        self._handlers[descriptor] = handler
        self._poll.register(descriptor, select.POLLIN)
        self._start()

    def _start(self) -> None:
        """Start the thread, or wake it: there is one more input."""
        if "bhd-estop" not in [thread.name for thread in self._threads]:
            self._run_thread("bhd-estop", self._work)
        os.write(self._wake, b"\0")

    def _run_thread(self, name: str, target: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=target, args=arguments, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _work(self) -> None:
        while not self._stop.is_set():
            events = self._poll.poll(1000 * _ROUND_S if self._broken or self._silence else None)
            for descriptor, _ in events:
                if descriptor == self._waker:
                    os.read(self._waker, 64)
                else:
                    self._listen(descriptor)
            for cause in self._broken:
                self.press(cause)
            if not events:  # rounds are counted, not time: if this thread gets no processor, neither do the others
                self._count_silence()

    def _listen(self, descriptor: int) -> None:
        try:
            received = os.read(descriptor, 4096)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        self._handlers[descriptor](received)

    def _count_silence(self) -> None:
        for name in list(self._silence):
            self._silence[name] -= 1
            if self._silence[name] <= 0:
                self.press(f"{name} does not answer")

    # --- the end -----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Take no more presses; give terminal and signals back. May be called twice; in the main thread."""
        if self._stop.is_set():
            return
        self._stop.set()
        os.write(self._wake, b"\0")
        if self._keys is not None:
            self._keys.unsubscribe(self._on_terminal_keys)
        # Outside of the main thread handler and pipe stay, and do nothing any more.
        with contextlib.suppress(ValueError):
            for number, handler in self._signals.items():
                signal.signal(number, signal.SIG_IGN if handler in (None, signal.SIG_DFL) else handler)
            if self._pipe is not None:
                signal.set_wakeup_fd(-1)
        for thread in self._threads:
            thread.join(0.2)  # a callable that hangs keeps its own thread, and nothing else
        is_main = threading.current_thread() is threading.main_thread()
        for descriptor in (self._waker, self._wake, *(self._pipe if is_main and self._pipe else ())):
            os.close(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
