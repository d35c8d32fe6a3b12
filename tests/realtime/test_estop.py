"""Every input presses, stays pressed where it must, and leaves terminal and signals as they were."""

import ctypes
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest

from bhd_lerobot.control.messages import Mode, Request
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.estop import SIGNALS, EstopInputs, estop_signal
from tests.control.support import Rig
from tests.waiting import until


class Button:
    """The word that inputs press, and a test clears."""

    def __init__(self) -> None:
        self.word = threading.Event()

    def press(self) -> None:
        self.word.set()

    def is_pressed(self) -> bool:
        return self.word.wait(10)


@pytest.fixture
def button() -> Button:
    return Button()


@pytest.fixture
def inputs(button: Button) -> Iterator[EstopInputs]:
    with EstopInputs(button.press) as inputs:
        yield inputs


@pytest.fixture
def wire() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    for end in (reader, writer):
        with suppress(OSError):
            os.close(end)


def wait_for_cause(inputs: EstopInputs, cause: str) -> None:
    until(lambda: cause in inputs.causes)


def test_every_byte_presses_and_a_cut_wire_stays_pressed(button, inputs, wire):
    inputs.add(wire[0], "button")
    assert not button.word.is_set()
    for _ in range(3):
        button.word.clear()
        os.write(wire[1], b"x")
        assert button.is_pressed()
    assert inputs.causes == ["button"]
    os.close(wire[1])
    wait_for_cause(inputs, "button is closed or broken")
    for _ in range(3):
        button.word.clear()  # a reset does not help
        assert button.is_pressed()


def test_an_error_on_a_descriptor_presses(button, inputs):
    ours, theirs = socket.socketpair()
    inputs.add(ours, "relay")
    ours.close()  # behind our back: the descriptor is not valid any more
    theirs.close()
    inputs.add(lambda: False)  # anything that wakes the thread
    assert button.is_pressed()
    assert inputs.causes == ["relay is closed or broken"]


def test_a_callable_presses_as_long_as_it_returns_true_or_raises(button, inputs):
    state = {"pressed": False}
    inputs.add(lambda: state["pressed"], "relay", period_s=0.001)
    asked = threading.Event()
    inputs.add(asked.set, "witness", period_s=0.001)
    assert asked.wait(20)
    assert not button.word.is_set()
    state["pressed"] = True
    for _ in range(3):
        assert button.is_pressed()
        button.word.clear()
    assert inputs.causes == ["relay"]
    inputs.add(lambda: 1 / 0, "bus", period_s=0.001)
    wait_for_cause(inputs, "bus failed: ZeroDivisionError: division by zero")
    assert button.is_pressed()


def test_a_callable_that_hangs_presses_and_holds_up_no_other_input(button, wire):
    let_go = threading.Event()
    with EstopInputs(button.press) as inputs:
        inputs.add(lambda: let_go.wait(30), "relay", period_s=0.001)
        inputs.add(wire[0], "button")
        os.write(wire[1], b"x")
        wait_for_cause(inputs, "button")
        wait_for_cause(inputs, "relay does not answer")
        assert inputs.causes == ["button", "relay does not answer"]
        let_go.set()


@pytest.mark.parametrize("number", [estop_signal(name) for name in (*SIGNALS, "usr2")])
def test_a_signal_presses_and_the_former_handler_comes_back(button, number):
    def handler(*_: object) -> None:
        raise AssertionError("the former handler must not run")

    former = signal.signal(number, handler)
    try:
        with EstopInputs(button.press) as inputs:
            inputs.add_signal(number)
            os.kill(os.getpid(), number)
            assert button.is_pressed()
            assert inputs.causes == [f"signal {number.name}"]
        assert signal.getsignal(number) is handler
        assert signal.set_wakeup_fd(-1) == -1
    finally:
        signal.signal(number, former)


def test_a_signal_presses_though_the_main_thread_does_not_come_back_to_python(button, inputs):
    inputs.add_signal(signal.SIGUSR1)
    library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)
    pressed: list[bool] = []
    go = threading.Event()

    def other() -> None:
        go.wait(20)
        os.kill(os.getpid(), signal.SIGUSR1)
        pressed.append(button.is_pressed())
        library.pthread_mutex_unlock(mutex)

    library.pthread_mutex_lock(mutex)
    thread = threading.Thread(target=other)
    thread.start()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(60)  # the other thread goes on when this one is in the call, and not before
    go.set()
    library.pthread_mutex_lock(mutex)  # no signal ends this call, and no handler of Python runs before it ends
    sys.setswitchinterval(interval)
    thread.join(20)
    assert pressed == [True]


def test_a_wake_up_descriptor_of_another_library_is_left_alone(button):
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    try:
        with EstopInputs(button.press) as inputs:
            inputs.add_signal(signal.SIGUSR1)
            os.kill(os.getpid(), signal.SIGUSR1)
            assert button.is_pressed()
    finally:
        assert signal.set_wakeup_fd(-1) == writer
        os.close(reader)
        os.close(writer)


def test_a_signal_outside_of_the_main_thread_is_refused(inputs):
    errors: list[str] = []

    def work() -> None:
        try:
            inputs.add_signal()
        except ConfigError as error:
            errors.append(str(error))

    thread = threading.Thread(target=work, name="worker")
    thread.start()
    thread.join(20)
    assert len(errors) == 1
    assert "main thread only" in errors[0]
    assert "'worker'" in errors[0]


@pytest.mark.parametrize("name", ["SIGINT", "SIGKILL", "SIGTERM", "", "9", "SIGFOO"])
def test_a_reserved_signal_is_refused(name):
    with pytest.raises(ConfigError, match="Valid: SIGUSR1"):
        estop_signal(name)


def test_invalid_estop_inputs_are_refused(inputs, wire):
    with open(os.devnull) as closed:
        pass
    for source, period, message in (
        ("button", 0.01, "give a file descriptor"),
        (None, 0.01, "None"),
        (1 << 20, 0.01, "Bad file descriptor"),
        (closed, 0.01, "closed file"),
        (bool, 0.0, "period_s is 0"),
        (bool, float("nan"), "period_s is nan"),
    ):
        with pytest.raises(ConfigError, match=message):
            inputs.add(source, period_s=period)
    assert not inputs.add_key(wire[0])  # it is no terminal


def test_an_emergency_stop_that_no_tick_has_seen_survives_a_restart():
    """Pressed between two episodes: the next one begins stopped."""
    rig = Rig()
    rig.cerebellum.estop.press()
    rig.cerebellum.restart(np.arange(1))
    rig.request(Request.CONFIGURE)
    rig.request(Request.ACTIVATE)
    rig.tick()
    assert rig.mode == Mode.ESTOP
    rig.cerebellum.restart(np.arange(1))  # this one was seen: a new episode is a new beginning
    rig.tick()
    assert rig.mode == Mode.UNCONFIGURED


@pytest.mark.parametrize("is_main", [True, False])
def test_after_close_nothing_presses_and_no_thread_or_descriptor_is_left(button, wire, is_main):
    def use() -> None:
        inputs = EstopInputs(button.press)
        inputs.add(wire[0])
        inputs.add(lambda: False, period_s=0.001)
        inputs.close()
        inputs.close()

    before = threading.active_count(), len(os.listdir("/proc/self/fd"))
    if is_main:
        use()
    else:
        with ThreadPoolExecutor(1) as other:
            other.submit(use).result()
    assert (threading.active_count(), len(os.listdir("/proc/self/fd"))) == before
    os.write(wire[1], b"x")
    assert not button.word.is_set()
    assert os.read(wire[0], 1) == b"x"  # it is left for the next reader


_CHILD = """
import fcntl, os, signal, sys, termios, time
from bhd_lerobot.realtime.estop import EstopInputs

def press():
    print("pressed", flush=True)

fcntl.ioctl(0, termios.TIOCSCTTY)
inputs = EstopInputs(press)
print("key", inputs.add_key(), inputs.add_key(), flush=True)
{}
"""


class Terminal:
    """A terminal with a program in its foreground, and a person in front of it."""

    def __init__(self, program: str) -> None:
        self.person, device = pty.openpty()
        self.before = termios.tcgetattr(device)
        self.process = subprocess.Popen(
            [sys.executable, "-c", _CHILD.format(program)],
            stdin=device,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.device = device

    def expect(self, line: str) -> None:
        assert self.process.stdout.readline().strip() == line

    def type(self, keys: bytes) -> None:
        os.write(self.person, keys)

    def end(self) -> tuple[int, str]:
        _, error = self.process.communicate()
        return self.process.returncode, error

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.person)
        os.close(self.device)


@pytest.fixture
def terminal() -> Iterator[Callable[[str], Terminal]]:
    made: list[Terminal] = []

    def make(program: str) -> Terminal:
        made.append(Terminal(program))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_space_and_e_press_at_once_other_keys_do_not_and_ctrl_c_leaves_the_terminal_as_it_was(terminal):
    one = terminal("while True: time.sleep(1)")
    one.expect("key True False")  # a second time there is nothing to be done
    mode = termios.tcgetattr(one.device)
    assert not mode[3] & (termios.ICANON | termios.ECHO)
    assert mode[3] & termios.ISIG
    for keys in (b" ", b"e", b"E", b"xyz e\n"):  # no Enter is needed
        one.type(b"qx\n")
        one.type(keys)
        one.expect("pressed")
    assert one.process.poll() is None
    one.type(b"\x03")
    ended, said = one.end()
    assert (ended, "KeyboardInterrupt" in said) == (-signal.SIGINT, True)
    assert termios.tcgetattr(one.device) == one.before


def test_after_an_error_of_the_program_the_terminal_is_as_it_was(terminal):
    one = terminal("raise RuntimeError('a bug')")
    one.expect("key True False")
    ended, said = one.end()
    assert (ended, "a bug" in said) == (1, True)
    assert termios.tcgetattr(one.device) == one.before


def test_in_the_background_the_terminal_is_left_alone(terminal):
    one = terminal(
        "inputs.close()\n"
        "pid = os.fork()\n"
        "if pid == 0:\n"
        "    os.setpgid(0, 0)\n"
        "    again = EstopInputs(press)\n"
        "    print('background', again.add_key(), flush=True)\n"
        "    os._exit(0)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))"
    )
    one.expect("key True False")
    one.expect("background False")
    assert one.end()[0] == 0
    assert termios.tcgetattr(one.device) == one.before
