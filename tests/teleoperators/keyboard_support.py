"""A clock that stands still, and a terminal in whose foreground this process is said to be."""

import os
import pty
from collections.abc import Iterator

import pytest

from bhd_lerobot.realtime import keys
from bhd_lerobot.realtime.keys import KeyTerminal
from bhd_lerobot.teleoperators import keyboard
from bhd_lerobot.teleoperators.keyboard import KeyboardTeleoperator
from tests.waiting import until


class Clock:
    """A clock [s] that goes on when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Person:
    """Somebody in front of a terminal."""

    def __init__(self) -> None:
        self._end, self.device = pty.openpty()

    def press(self, typed: str, teleoperator: KeyboardTeleoperator) -> None:
        """Press keys, and wait until the teleoperator has them."""
        before = len(teleoperator._events)
        os.write(self._end, typed.encode())
        until(lambda: len(teleoperator._events) == before + len(typed))

    def close(self) -> None:
        os.close(self._end)
        os.close(self.device)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def person(monkeypatch: pytest.MonkeyPatch) -> Iterator[Person]:
    person = Person()
    monkeypatch.setattr(KeyTerminal, "usable", staticmethod(os.isatty))
    monkeypatch.setattr(keys, "_sources", {})
    monkeypatch.setattr(keyboard, "key_source", lambda: keys.key_source(person.device))
    yield person
    person.close()
