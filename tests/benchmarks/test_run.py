"""Every benchmark starts: once, in its shortest form; and what their exit statuses say."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import run
from benchmarks._turns import GOAL_MISSED
from tests.forks import Fork

# The shortest form of each: a benchmark that is new has none, and fails here until it gets one.
SHORT = {
    "arms": "--episodes=1 --case=reach",
    "bags": "--episodes=1 --frames=10 --turns=1",
    "brains": "--episodes=2 --episode_s=1",
    "check": "--episodes=2 --frames=10 --turns=1",
    "cluster": "--episodes=2 --episode_s=1 --turns=1",
    "contact": "--speeds=3 --frames=5",
    "envs": "--n=1 --repeats=1 --seconds=0.1 --peers sync",
    "impedance": "--quick",
    "kinematics": "--poses=2",
    "lines": "--lines=1",
    "loader": "--episodes 1 0 --repeats=1 --seconds=0.1 --no_start",
    "motion": "--motions=1",
    "navigate": "--episodes=1",
    "realtime": "--quick --seconds=0.2 --robots=ur5 --conditions=quiet",
    "record": "--repeats=1 --simulated_s=1 --robots=turtlebot3 --n_envs=1",
    "recording": "--episodes=1 --length=20 --repeats=1",
    "robots": "--seconds=4 --rounds=1",
    "ros2": "--rounds=1 --seconds=1",
    "ros2_record": "--rounds=1 --seconds=2",
    "sight": "--rounds=1 --seconds=0.2",
    "wire": "--streams=7 --frames=2 --spaces wheels impedance",
}
# A minute or more each, because they start several interpreters, each of which imports PyTorch and LeRobot.
SLOW = {"cluster", "robots", "ros2", "ros2_record"}


# MuJoCo chooses how it renders while it is imported, and this benchmark chooses before.
OWN_INTERPRETER = {"record"}


def _benchmark(name: str, *options: str) -> None:
    """Run a benchmark as `python -m` does."""
    sys.argv = [name, *options]
    runpy.run_module(f"benchmarks.{name}", run_name="__main__")


@pytest.mark.thorough
@pytest.mark.parametrize("name", run.NAMES)
def test_a_benchmark_runs_in_its_shortest_form(name: str, tmp_path: Path) -> None:
    if name in SLOW and os.environ.get("BHD_SWEEP") != "full":
        pytest.skip("takes minutes: it starts several interpreters; runs with BHD_SWEEP=full")
    options = SHORT[name]
    log = tmp_path / "log"
    if name in OWN_INTERPRETER:
        command = [sys.executable, "-m", f"benchmarks.{name}", *options.split()]
        with log.open("wb") as file:
            status = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    else:
        status = Fork(_benchmark, name, *options.split(), output=log).wait()
    printed = log.read_text(encoding="utf-8", errors="replace")
    # A busy machine may stop every loop that is to be measured in real time.
    assert status in (0, GOAL_MISSED) or (status == 2 and "Nothing was measured" in printed), printed[-3000:]


def test_a_crash_and_a_missed_goal_have_statuses_of_their_own(monkeypatch, capsys):
    statuses = {"arms": 0, "bags": GOAL_MISSED, "check": 1, "motion": -9, "wire": 2}
    assert GOAL_MISSED not in (0, 1, 2)  # of success, of an exception, and of wrong options

    def fake(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, statuses[command[-1].removeprefix("benchmarks.")])

    monkeypatch.setattr(subprocess, "run", fake)
    assert run.main(["arms"]) == 0
    assert run.main(["arms", "bags"]) == GOAL_MISSED
    assert "Goals missed: bags." in capsys.readouterr().err
    for name in ("check", "motion", "wire"):
        assert run.main(["arms", "bags", name]) == 1
        assert f"Failed: {name}." in capsys.readouterr().err
    assert run.main(["no_such"]) == 2
