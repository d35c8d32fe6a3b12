import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.realtime import robots
from benchmarks.realtime.cases import CaseError
from benchmarks.realtime.owner import Lines, OwnerSpec, Sway, as_argument
from benchmarks.realtime.robots import OwnedRobot, is_running, standing_still
from benchmarks.realtime.watcher import Watcher
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]


def state_of(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def wait_for_state(pid: int, wanted: str) -> None:
    until(lambda: state_of(pid) in wanted)


def test_a_process_stands_still_for_a_block_and_goes_on_after_it() -> None:
    with subprocess.Popen(["sleep", "60"]) as child:
        try:
            with standing_still(child.pid):
                wait_for_state(child.pid, "T")
            wait_for_state(child.pid, "SR")
        finally:
            child.kill()
    assert not is_running(child.pid)
    with pytest.raises(CaseError, match="could not be stopped"), standing_still(child.pid):
        pass


def test_a_process_goes_on_when_the_one_that_stopped_it_is_killed() -> None:
    text = (
        "import sys, time\nfrom benchmarks.realtime.robots import standing_still\n"
        "with standing_still(int(sys.argv[1])):\n    print('up', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(["sleep", "60"]) as child:
        try:
            arguments = [sys.executable, "-c", text, str(child.pid)]
            with subprocess.Popen(arguments, cwd=ROOT, stdout=subprocess.PIPE) as other:
                assert other.stdout is not None
                assert other.stdout.readline() == b"up\n"
                wait_for_state(child.pid, "T")
                other.kill()
            wait_for_state(child.pid, "SR")
        finally:
            child.kill()


def test_an_owner_that_cannot_start_its_robot_says_why_and_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "as_argument", lambda _: '{"name": "x", "robot": "ur5", "nonsense": 1}')
    robot = OwnedRobot(OwnerSpec("bench-test-bad", "ur5"))
    with pytest.raises(CaseError, match="nonsense"):
        robot.prepare()
    assert robot.close() == []
    assert not is_running(robot.process.pid)
    with pytest.raises(CaseError, match="has ended"):
        robot.tell("run 1")


def test_an_owner_does_not_outlive_who_started_it() -> None:
    specification = as_argument(OwnerSpec("bench-test-orphan", "ur5"))
    wrong = [sys.executable, "-m", "benchmarks.realtime.owner", specification, str(os.getpid() + 1)]
    done = subprocess.run(wrong, cwd=ROOT, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (1, b"")


def test_a_robot_that_does_not_run_cannot_be_watched() -> None:
    with pytest.raises(CaseError, match="bench-test-nobody"):
        Watcher("bench-test-nobody")


def test_lines_come_whole_and_the_end_is_one() -> None:
    read, write = os.pipe()
    lines = Lines(read)
    assert lines.next(0.0) is None
    os.write(write, b"run 3\npau")
    assert lines.next(0.0) == "run 3"
    assert lines.next(0.0) is None
    os.write(write, b"se\n")
    assert lines.next(0.0) == "pause"
    os.close(write)
    assert lines.next(0.0) == "end"
    assert lines.next(None) == "end"
    os.close(read)


def test_a_swaying_arm_turns_back_before_it_is_far_away() -> None:
    sway = Sway("ur5", 25)
    start = np.array([[3.0, -1.5, 1.5, -1.5, -1.5, 0.0, 0.1]])
    command, ways = start.copy(), []
    for k in range(400):
        after = sway.next(command, k / 25)
        assert np.all(np.abs(after - command) <= 0.15 / 25 + 1e-12)
        assert np.any(after != command)
        command = after
        ways.append(float(np.abs(command - start).max()))
    assert 0.15 < max(ways) < 0.3


def test_a_swaying_base_turns_back() -> None:
    sway = Sway("turtlebot3", 10)
    twists = np.array([sway.next(np.zeros((1, 2)), k / 10)[0] for k in range(100)])
    assert np.all(np.abs(twists) == np.abs(twists[0]))
    assert abs(twists[:, 0].sum()) < 0.2 * np.abs(twists[:, 0]).sum()
