"""What both keyboard teleoperators have in common: keys of a terminal, which reports presses and no releases."""

import sys
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping

from bhd_lerobot.realtime.keys import KeySource, key_source
from bhd_lerobot.teleoperators.config_keyboard import KeyboardConfig
from bhd_lerobot.teleoperators.plain import PlainTeleoperator, TeleoperatorConfigError

FASTER, SLOWER = 1.1, 0.9
"""Factors of a speed, for each press of a key that changes it."""


def say(text: str) -> None:
    """Print for the person at the keys; LeRobot's commands leave the cursor at the beginning of a line of theirs."""
    print(f"\x1b[K{text}" if sys.stderr.isatty() else text, file=sys.stderr, flush=True)


class KeyboardTeleoperator(PlainTeleoperator):
    """A teleoperator whose keys come from the terminal in whose foreground the program runs, also over SSH.

    A key is followed until another is pressed, and for `config.hold_s` at most. Every key without a meaning stops, so
    that the emergency stop's keys and the recorder's do so, too. Upper case letters have no meaning.

    Args:
        config: the configuration.
        motions: the keys that move the robot while they are held, and two numbers that say how.
        clock: the time [s].
    """

    config: KeyboardConfig

    def __init__(
        self, config: KeyboardConfig, motions: Mapping[str, tuple[int, int]], clock: Callable[[], float]
    ) -> None:
        super().__init__(config)
        self.config, self.motions = config, motions
        self._clock = clock
        self._source: KeySource | None = None
        self._events: deque[tuple[float, str]] = deque(maxlen=256)  # from the thread that reads to the one that asks
        self._held, self._until = "", 0.0

    @property
    @abstractmethod
    def help(self) -> str:
        """What the keys do, in lines."""

    @abstractmethod
    def adjust(self, key: str) -> bool:
        """Apply a key that is pressed once and not held; return whether it is one. The motion is not changed."""

    def held(self, now: float) -> str:
        """Apply what was pressed until now; return the key that is followed now, or "" if there is none."""
        while self._events:
            pressed, key = self._events.popleft()
            if now - pressed > self.config.hold_s:
                continue  # nothing was asked for meanwhile: it was not meant for this moment
            if key in self.motions:
                self._held, self._until = key, pressed + self.config.hold_s
            elif not self.adjust(key):
                self._held = ""
        return self._held if now <= self._until else ""

    def _on_keys(self, keys: bytes) -> None:
        now = self._clock()
        self._events.extend((now, key) for key in keys.decode("ascii", "replace"))

    @property
    def is_connected(self) -> bool:
        """Whether it reads the terminal."""
        return self._source is not None

    def connect(self, calibrate: bool = True) -> None:
        """Take the terminal, and print to standard error what the keys do.

        Raises:
            DeviceAlreadyConnectedError: it is connected.
            TeleoperatorConfigError: standard input is no terminal that this program has to itself.
        """
        self.check_new()
        source = key_source()
        if source is None:
            raise TeleoperatorConfigError(
                f"{self.name} reads keys, and standard input is no terminal in whose foreground this program runs. "
                "Start it in a terminal, without a pipe, a redirection or `&`; over SSH with `ssh -t`, in a container "
                "with `docker run -it`. Or choose another --teleop.type."
            )
        source.subscribe(self._on_keys)
        self._source = source
        say(self.help)

    def disconnect(self) -> None:
        """Give the terminal back. May be called twice."""
        if self._source is not None:
            self._source.unsubscribe(self._on_keys)
            self._source = None
        self._events.clear()
        self._held = ""
