"""Processes that are killed or stopped: the stated safe state is reached, nothing is left behind, and it goes on."""

import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from bhd_lerobot.cli.record import main
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.shared_memory import sweep
from bhd_lerobot.robots.host import link
from bhd_lerobot.robots.host.simulation import Simulation
from tests.forks import Fork
from tests.recording.support import options
from tests.robots.host.support import (
    States,
    drive,
    driving_child,
    is_alive,
    is_gone,
    turtlebot,
    unique,
    watchdog_count,
)
from tests.waiting import until

TIMEOUT_S = 0.3


def test_a_cerebellum_that_is_killed_or_stopped_is_reported_and_ended_and_there_is_life_after_it(monkeypatch):
    monkeypatch.setattr(link, "_END_S", 0.5)
    name = unique("killed")
    robot = turtlebot(name)
    for number, message in (
        (signal.SIGKILL, "cerebellum's process was killed by signal 9. The simulated robot ended with it"),
        (signal.SIGSTOP, "published nothing for"),
    ):
        with robot:
            drive(robot)
            pid = robot.host.link.pid
            os.kill(pid, number)
            until(lambda wanted=message: wanted in complaint(robot.get_observation), "the robot says what happened")
            assert message in complaint(lambda: robot.send_action({"x.vel": 0.2, "theta.vel": 0.0}))
        assert is_gone(name)
        assert not is_alive(pid)


class Broken(Simulation):
    """Of a plug-in with a bug: it raises when the robot is sent on."""

    def _after_tick(self) -> None:
        super()._after_tick()
        if self.cerebellum.command[0, 0] > 0.0:
            raise ZeroDivisionError("a bug of a plug-in")


def test_what_a_cerebellum_raises_is_reported():
    robot = turtlebot(unique("broken"))
    robot.simulation_class = Broken
    with robot:
        robot.send_action({"x.vel": 0.2, "theta.vel": 0.0})
        until(lambda: "ended with status 1" in complaint(robot.get_observation), "it has ended")
        for _ in range(2):
            assert "ZeroDivisionError: a bug of a plug-in" in complaint(robot.get_observation)


@pytest.mark.thorough
def test_a_brain_that_is_stopped_at_any_moment_leaves_nothing_half_sent(tmp_path):
    """It sends all the time: some of these moments are within a command that it writes."""
    name = unique("stopped")
    rng = random.Random(0)
    with driving_child(name, tmp_path / "log", brain_timeout_s=0.1) as (brain, _):
        states = States(name)
        for _ in range(12):
            until(lambda: states.read().all and states.all[-1]["state"]["mode"] == Mode.TRACKING, "the base drives")
            time.sleep(rng.uniform(0.0, 0.06))
            brain.send_signal(signal.SIGSTOP)
            until(lambda: states.read().all[-1]["state"]["mode"] == Mode.HOLD, "the base holds")
            brain.send_signal(signal.SIGCONT)
        last = states.read().all[-1]
        assert not any(watchdog_count(last, one) for one in (Watchdog.GUARD, Watchdog.PLANT, Watchdog.BLOCKED))
        assert not any(state["state"]["mode"] in (Mode.FAULT, Mode.ESTOP) for state in states.all)
        assert all(abs(state["state"]["command"][0]) <= 0.2 + 1e-9 for state in states.all)
        states.block.close()


def complaint(call: Callable[[], object]) -> str:
    """Return what a call complains about; nothing if it does not."""
    try:
        call()
    except RealtimeError as error:
        return str(error)
    return ""


def expect_exact_timeout(states: States, word: Word) -> None:
    """The tick that stopped the robot is the first that started more than the time-out after the last sign of life."""
    alive = int(states.block.words[word])
    first = states.first(Mode.STOPPING)
    stopped, before = states.all[first], states.all[first - 1]
    assert int(stopped["executed"]) == int(before["executed"]) + 1  # no state between them was lost
    assert int(stopped["start_ns"]) - alive > TIMEOUT_S * 1e9
    assert int(before["start_ns"]) - alive <= TIMEOUT_S * 1e9
    assert before["state"]["mode"] == Mode.TRACKING
    # From there on it only slows down, and then holds.
    rest = states.all[first:]
    speeds = [float(state["state"]["command"][0]) for state in rest if state["state"]["mode"] == Mode.STOPPING]
    assert speeds == sorted(speeds, reverse=True)
    hold = states.first(Mode.HOLD)
    assert states.all[hold]["state"]["command"][:2].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("buffer_s", [0.3, 10.0])
def test_a_brain_that_reads_late_gets_all_frames_that_the_ring_holds_and_what_it_loses_is_counted(buffer_s):
    name = unique("late")
    with turtlebot(name, buffer_s=buffer_s) as robot:
        host: Any = robot.host
        ring, words, frame = host.link.block.ring, host.link.block.words, host.rates.ticks_per_frame
        last = host.step(None).number
        seen = len(ring)
        until(lambda: len(ring) > seen + 100, "states come that nobody reads")
        report = host.step(None)
        numbers = [one.number for one in (*report.missed, report)]
        late, drops = len(ring) - seen, int(words[Word.RECORDER_DROPS])
        # A frame is missing if and only if states were lost: as many as were gone when it was read, and no more.
        whole = list(range(last + 1, numbers[-1] + 1))
        assert numbers == sorted(set(numbers))
        assert len(numbers) > 2
        if late < ring.capacity:
            assert (numbers, drops) == (whole, 0)
        else:
            assert len(whole) - len(numbers) <= drops / frame + 1
            assert 0 < drops < late
        assert words[Word.RECORDER_FRAMES] == last + 1 + len(numbers)
    assert is_gone(name)


def test_a_brain_that_is_stopped_and_then_killed_leaves_a_robot_that_holds_and_ends(tmp_path):
    name = unique("brain")
    with driving_child(name, tmp_path / "log", brain_timeout_s=TIMEOUT_S) as (child, report):
        pid = report["pid"]
        for number in (signal.SIGSTOP, signal.SIGKILL):
            states = States(name)
            until(lambda read=states: read.has(Mode.TRACKING), "the base moves, at first or again")
            del states.all[: states.first(Mode.TRACKING)]  # it may have held still from the time before
            child.send_signal(number)
            until(lambda read=states: read.has(Mode.HOLD), "the base holds")
            expect_exact_timeout(states, Word.BRAIN_ALIVE)
            # What was raised is counted with the next frame, perhaps after a slow base stands.
            until(lambda read=states: watchdog_count(read.read().all[-1], Watchdog.BRAIN) >= 1, "it is counted")
            states.block.close()
            if number == signal.SIGSTOP:
                assert is_alive(pid)
                child.send_signal(signal.SIGCONT)
        until(lambda: not is_alive(pid), "the process ends by itself")
    sweep()  # this test may have been the last that held it
    assert is_gone(name)


def stand(name: str) -> None:
    """Connect a base and let it stand, while a process of this one holds what goes to the base's."""
    robot = turtlebot(name)
    robot.connect()
    robot.host.link.pause()
    command = [sys.executable, "-c", "import time; time.sleep(600)"]
    with subprocess.Popen(command, pass_fds=(robot.host.link._pipe.fileno(),)) as helper:
        print(json.dumps({"pid": robot.host.link.pid, "helper": helper.pid}), flush=True)


def test_a_robot_that_stands_ends_with_its_brain_whatever_that_has_forked(tmp_path):
    child = Fork(stand, unique("stands"), output=tmp_path / "log")
    until(lambda: (tmp_path / "log").read_text().endswith("\n"), "the base stands")
    report = json.loads((tmp_path / "log").read_text())
    child.kill()
    try:
        until(lambda: not is_alive(report["pid"]), "the process ends by itself")
    finally:
        os.kill(report["helper"], signal.SIGKILL)
    sweep()


PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23


@pytest.fixture
def unprivileged() -> Iterator[ThreadPoolExecutor]:
    """A thread whose child processes may not have the right to SCHED_FIFO; the rest of this process keeps it."""
    library = ctypes.CDLL(None, use_errno=True)
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))"
    with ThreadPoolExecutor(1) as thread:
        if thread.submit(library.prctl, PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0).result() and os.geteuid() == 0:
            pytest.skip("rights cannot be given up here")
        tried = thread.submit(subprocess.run, [sys.executable, "-c", code], capture_output=True, check=False).result()
        if b"PermissionError" not in tried.stderr:
            pytest.skip("a limit of the system (rtprio) grants SCHED_FIFO without the right")
        yield thread


def test_without_sched_fifo_it_runs_and_reports_the_refusal(unprivileged):
    name = unique("unprivileged")
    robot = turtlebot(name)
    try:
        unprivileged.submit(robot.connect).result()
        grants = {grant["name"]: grant for grant in robot.host.clock.grants}
        assert not grants["scheduler"]["granted"]
        assert "SCHED_OTHER" in grants["scheduler"]["detail"]
        assert "setcap" in grants["scheduler"]["remedy"]
        assert grants["timer slack"]["granted"]
        assert os.sched_getscheduler(robot.host.link.pid) == os.SCHED_OTHER
        drive(robot)
    finally:
        robot.disconnect()
    assert is_gone(name)


def test_require_realtime_without_sched_fifo_starts_nothing(unprivileged, tmp_path, capsys):
    name = unique("required")
    arguments = options(
        tmp_path / "d", robot__clock="realtime", robot__id=name, robot__require_realtime="true", n_envs=1
    )
    assert unprivileged.submit(main, arguments).result() == 2
    output = " ".join(capsys.readouterr().err.split())
    assert "SCHED_FIFO" in output
    assert "setcap" in output
    assert "Traceback" not in output
    assert not (tmp_path / "d").exists()
    assert is_gone(name)
