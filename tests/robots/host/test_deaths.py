"""Processes that are killed or stopped: the stated safe state is reached, nothing is left behind, and it goes on."""

import ctypes
import itertools
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
from bhd_lerobot.realtime.frame_log import FrameLog
from bhd_lerobot.realtime.shared_memory import sweep
from bhd_lerobot.robots.host import link
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
            pids = robot.host.link.pids
            os.kill(pids["cerebellum"], number)
            until(lambda wanted=message: wanted in complaint(robot.get_observation), "the robot says what happened")
            assert message in complaint(lambda: robot.send_action({"x.vel": 0.2, "theta.vel": 0.0}))
        assert is_gone(name)
        assert not any(is_alive(pid) for pid in pids.values())


@pytest.mark.thorough
def test_a_brain_that_is_stopped_at_any_moment_leaves_nothing_half_sent(tmp_path):
    """It sends all the time: some of these moments are within a command that it writes."""
    name = unique("stopped")
    rng = random.Random(0)
    with driving_child(name, tmp_path / "log", brain_timeout_s=0.1) as (brain, _):
        states = States(name)
        for _ in range(12):
            until(lambda: states.read().all and states.all[-1]["mode"][0] == Mode.TRACKING, "the base drives")
            time.sleep(rng.uniform(0.0, 0.06))
            brain.send_signal(signal.SIGSTOP)
            until(lambda: states.read().all[-1]["mode"][0] == Mode.HOLD, "the base holds")
            brain.send_signal(signal.SIGCONT)
        last = states.read().all[-1]
        assert not any(watchdog_count(last, one) for one in (Watchdog.GUARD, Watchdog.PLANT, Watchdog.BLOCKED))
        assert not any(state["mode"][0] in (Mode.FAULT, Mode.ESTOP) for state in states.all)
        assert all(abs(state["command"][0, 0]) <= 0.2 + 1e-9 for state in states.all)
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
    assert before["mode"][0] == Mode.TRACKING
    # From there on it only slows down, and then holds.
    rest = states.all[first:]
    speeds = [float(state["command"][0, 0]) for state in rest if state["mode"][0] == Mode.STOPPING]
    assert speeds == sorted(speeds, reverse=True)
    hold = states.first(Mode.HOLD)
    assert states.all[hold]["command"].tolist() == [[0.0, 0.0]]


def test_a_stopped_recorder_loses_states_that_are_counted_exactly_and_a_killed_one_is_reported():
    name = unique("stopped")
    with turtlebot(name, recorder_timeout_s=TIMEOUT_S, buffer_s=0.5) as robot:
        drive(robot)
        recorder = robot.host.link.pids["recorder"]
        states = States(name)
        words, block = states.block.words, states.block
        log = FrameLog(block.state_dtype, block.about["frames"], block.section("frames")).reader()
        entries: list[Any] = []

        def read_log() -> list[Any]:
            while (entry := log.read()) is not None:
                entries.append(entry.copy())
            return entries

        until(read_log, "the recorder works")
        assert words[Word.RECORDER_DROPS] == 0
        os.kill(recorder, signal.SIGSTOP)
        until(lambda: states.has(Mode.HOLD), "the base holds")
        expect_exact_timeout(states, Word.RECORDER_ALIVE)
        # What the brain goes on sending does not move it.
        robot.send_action({"x.vel": 0.2, "theta.vel": 0.0})
        seen, held = len(states.read().all), states.first(Mode.HOLD)
        until(lambda: len(states.read().all) > seen + 20, "more states")
        assert {int(state["mode"][0]) for state in states.all[held:]} == {Mode.HOLD}
        ring = states.block.ring.capacity
        until(lambda: len(states.read().all) > 3 * ring, "the recorder fell behind by more than the ring holds")
        os.kill(recorder, signal.SIGCONT)
        until(lambda: words[Word.RECORDER_DROPS] > ring, "drops are counted")
        drive(robot)
        # In the log of frames there is a gap, and it is as long as the count says, but for what a frame lasts.
        robot.host.link.pause()
        until(lambda: read_log()[-1]["drops"] == words[Word.RECORDER_DROPS], "the recorder has taken all there is")
        frame, gaps = block.about["control_hz"] // block.about["fps"], 0
        for before, after in itertools.pairwise(entries):
            lost = int(after["drops"] - before["drops"])
            passed = int(after["state"]["executed"] - before["state"]["executed"])
            if lost:
                gaps += 1
                assert passed - frame <= lost < passed
        assert gaps >= 1
        os.kill(recorder, signal.SIGKILL)
        message = "recorder's process was killed by signal 9. The robot decelerates and holds"
        until(lambda: message in complaint(robot.get_observation), "the robot says what happened")
        assert message in complaint(lambda: robot.send_action({"x.vel": 0.2, "theta.vel": 0.0}))
    states.block.close()
    assert is_gone(name)


def test_a_brain_that_is_stopped_and_then_killed_leaves_a_robot_that_holds_and_ends(tmp_path):
    name = unique("brain")
    with driving_child(name, tmp_path / "log", brain_timeout_s=TIMEOUT_S) as (child, report):
        pids = report["pids"].values()
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
                assert all(is_alive(pid) for pid in pids)
                child.send_signal(signal.SIGCONT)
        until(lambda: not any(is_alive(pid) for pid in pids), "the processes end by themselves")
    sweep()  # this test may have been the last that held it
    assert is_gone(name)


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
        assert os.sched_getscheduler(robot.host.link.pids["cerebellum"]) == os.SCHED_OTHER
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
