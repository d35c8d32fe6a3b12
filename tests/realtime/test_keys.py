"""One terminal has many readers in a process: each gets every key, the emergency stop before the others."""

import os
import pty
import termios
import threading
from collections.abc import Iterator

import pytest

from bhd_lerobot.realtime import keys
from bhd_lerobot.realtime.estop import EstopInputs
from bhd_lerobot.realtime.keys import KeySource, KeyTerminal, key_source
from tests.waiting import until

Terminal = tuple[int, int]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """A terminal: its end for the person, and its end for the program, which may use it."""
    monkeypatch.setattr(KeyTerminal, "usable", staticmethod(os.isatty))
    monkeypatch.setattr(keys, "_sources", {})
    person, device = pty.openpty()
    yield person, device
    os.close(person)
    os.close(device)


def is_taken(device: int) -> bool:
    return not termios.tcgetattr(device)[3] & (termios.ICANON | termios.ECHO)


def test_the_emergency_stop_comes_first_and_others_cannot_disable_it(terminal, capsys):
    person, device = terminal
    source = key_source(device)
    assert source is not None
    order: list[str] = []

    def teleoperator(pressed: bytes) -> None:
        order.append("teleoperator")
        raise ValueError("a bug")

    source.subscribe(teleoperator)
    marked: list[bytes] = []
    with EstopInputs(lambda: order.append("stop"), marked.append) as inputs:
        assert inputs.add_key(device)
        for presses in range(1, 4):
            os.write(person, b"ie\n")
            until(lambda: len(order) == 2 * presses)  # noqa: B023  called in this round
    assert order == ["stop", "teleoperator"] * 3
    assert marked == [b"i\n"] * 3
    assert "a bug" in capsys.readouterr().err
    source.unsubscribe(teleoperator)


def test_the_terminal_is_taken_with_the_first_and_restored_with_the_last(terminal: Terminal) -> None:
    person, device = terminal
    before = termios.tcgetattr(device)
    threads = threading.active_count()
    source = key_source(device)
    assert source is key_source(device)  # one for the whole process
    assert source is not None
    got: list[bytes] = []
    others: list[bytes] = []
    for _ in range(3):
        got.clear()
        assert termios.tcgetattr(device) == before
        source.subscribe(got.append)
        source.subscribe(others.append)
        assert is_taken(device)
        assert termios.tcgetattr(device)[3] & termios.ISIG  # Ctrl-C
        os.write(person, b"i")
        until(lambda: got == [b"i"] and b"".join(others).endswith(b"i"))
        source.unsubscribe(others.append)
        assert is_taken(device)
        os.write(person, b"k")
        until(lambda: got == [b"i", b"k"])
        assert b"k" not in others
        source.unsubscribe(got.append)
        source.unsubscribe(got.append)
        assert threading.active_count() == threads
    assert termios.tcgetattr(device) == before


def test_keys_come_at_once_again_after_a_shell_has_had_the_terminal(terminal: Terminal) -> None:
    """By Ctrl-Z, and fg: the emergency stop does not wait for Enter."""
    person, device = terminal
    before = termios.tcgetattr(device)
    pressed = threading.Event()
    with EstopInputs(pressed.set) as inputs:
        assert inputs.add_key(device)
        for _ in range(2):
            termios.tcsetattr(device, termios.TCSANOW, before)
            pressed.clear()
            os.write(person, b" ")
            until(pressed.is_set, "it is pressed")
    assert termios.tcgetattr(device) == before


def test_while_the_terminal_is_lent_others_read_it_and_what_they_leave_comes_afterwards(terminal: Terminal) -> None:
    person, device = terminal
    before = termios.tcgetattr(device)
    source = key_source(device)
    assert source is not None
    got: list[bytes] = []
    source.subscribe(got.append)
    with source.lent():
        assert termios.tcgetattr(device) == before
        os.write(person, b"c\n")
        assert os.read(device, 10) == b"c\n"
        os.write(person, b"e")
    assert is_taken(device)
    until(lambda: got == [b"e"])
    source.unsubscribe(got.append)
    with source.lent():
        pass
    assert termios.tcgetattr(device) == before  # nobody has it


def test_a_terminal_that_is_gone_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KeyTerminal, "usable", staticmethod(os.isatty))
    person, device = pty.openpty()
    source = KeySource(device)
    got: list[bytes] = []
    source.subscribe(got.append)
    os.close(person)
    until(lambda: got == [b""])
    source.unsubscribe(got.append)
    os.close(device)


def test_what_is_no_terminal_has_no_keys() -> None:
    reader, writer = os.pipe()
    assert key_source(reader) is None
    os.close(reader)
    os.close(writer)
    assert key_source(reader) is None
