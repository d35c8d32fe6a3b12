"""The time between two episodes of a real robot."""

import io
import re
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.recording.reset import ResetPhase
from bhd_lerobot.recording.status import RecordStatus
from bhd_lerobot.recording.takes import Takes
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.host import LeRobotHost
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.free import FreeConfig, FreeTask
from tests.robots.external.mock_devices import MockArm, MockArmConfig, MockLeaderConfig
from tests.waiting import until

FPS = 50


class Rig:
    """Two short episodes with a wait between them, which ends as a test says."""

    def __init__(self, tmp_path: Path, wait_s: float, fault_at: int = 0, seconds: float = 0.1) -> None:
        fault = "disconnect" if fault_at else ""
        arm = MockArm(MockArmConfig(id="arm", calibration_dir=tmp_path, fault=fault, fault_at=fault_at))
        self.arm, self.host = arm, LeRobotHost(arm, FPS, GateConfig())
        arm.connect()
        self.stopped = False
        self.leader = leader = MockLeaderConfig(id="leader", calibration_dir=tmp_path)
        self.brain = TeleopBrain(TeleopConfig(leader))
        task = FreeTask(FreeConfig("wave", seconds), 1, FPS)
        self.loop = EpisodeLoop(self.host, task, self.brain)
        self.loop.marks = self.marks = Marks()
        self.text = io.StringIO()
        console = Console(file=self.text, width=100)
        self.loop.before_start = self.phase = ResetPhase(
            self.host, self.brain, self.marks, wait_s, stop=lambda: self.stopped, console=console
        )

    def run(self) -> list[Episode]:
        return list(self.loop.run([EpisodeSpec(0, 0), EpisodeSpec(1, 1)], lambda: self.stopped))

    def close(self) -> None:
        self.brain.close()
        self.host.close()


def test_the_leader_drives_and_nothing_is_recorded(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.5)) as rig:
        episodes = rig.run()
        assert all(1 <= episode.frames <= 5 for episode in episodes)  # fewer where a busy machine skips a frame
        assert len(episodes) == 2
        assert rig.arm.sent > sum(episode.frames for episode in episodes) + 5
        assert "0.5 s to set up the scene. Enter begins episode 1." in rig.text.getvalue()


@pytest.mark.parametrize("end", ["enter", "stop", "estop"])
def test_what_ends_the_wait(tmp_path: Path, end: str) -> None:
    with closing(Rig(tmp_path, 3600)) as rig:
        calls = {
            "enter": lambda: rig.marks.on_key(b"\r"),
            "stop": lambda: setattr(rig, "stopped", True),
            "estop": rig.host.estop,
        }

        def press() -> None:
            until(lambda: "Enter begins" in rig.text.getvalue())
            calls[end]()

        thread = threading.Thread(target=press)
        thread.start()
        episodes = rig.run()
        thread.join()
        # After a stop of either kind no episode is begun, not even for a frame.
        assert len(episodes) == (2 if end == "enter" else 1)
        assert rig.loop.emergency_stop == (end == "estop")
        assert not rig.host.running.any()


@pytest.mark.parametrize("fault_at", [1, 2, 5, 6, 7, 20], ids=lambda at: f"observation {at}")
def test_a_fault_of_the_robot_at_any_moment_ends_the_run_and_is_named(tmp_path: Path, fault_at: int) -> None:
    with closing(Rig(tmp_path, 0.0, fault_at=fault_at)) as rig:
        rig.marks.pause()
        episodes = rig.run()
        assert len(episodes) == (0 if fault_at == 1 else 1)
        assert rig.loop.fault
        assert "the bus does not answer" in (rig.loop.problem or rig.host.problem)
        assert not rig.host.running.any()
        assert fault_at < 20 or "Paused. Enter begins episode 1." in rig.text.getvalue()


def test_a_leader_that_fails_in_the_reset_phase_leaves_the_person_their_time(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 3600)) as rig:
        rig.leader.fault, rig.leader.fault_at = "raises", 12  # in the phase: each take asks it five times

        def press() -> None:
            until(lambda: "Nobody drives the robot" in rig.text.getvalue())
            time.sleep(0.3)
            assert not rig.host.running.any()
            rig.leader.fault = ""
            rig.marks.on_key(b"\r")

        thread = threading.Thread(target=press)
        thread.start()
        assert len(rig.run()) == 2
        thread.join()
        assert not rig.loop.fault


def test_the_key_of_the_reset_phase_discards_the_last_take_and_it_is_recorded_again(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 3600)) as rig:
        saved: list[int] = []
        counted: list[int] = []
        typed = iter([b"r\r", b"\r"])

        def press() -> None:
            for number, keys in enumerate(typed, 1):
                until(lambda number=number: rig.text.getvalue().count("Enter begins") == number)
                rig.marks.on_key(keys)
                time.sleep(0.8)  # an Enter that comes sooner is held

        thread = threading.Thread(target=press)
        thread.start()
        with Takes(lambda e: saved.append(e.spec.index), saved.pop, lambda e: counted.append(e.spec.index)) as takes:
            rig.phase.takes = takes
            for episode in rig.loop.run([EpisodeSpec(0, 0), EpisodeSpec(1, 1)]):
                takes.add(episode)
        thread.join()
        assert saved == counted == [0, 1]


def test_a_take_lasts_as_long_as_it_says_whatever_the_robot_keeps(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.0, seconds=3.0)) as rig:
        rig.arm.config.read_s = 0.05  # of 50 frames a second it keeps 17 to 20
        rig.loop.status = status = RecordStatus(
            Console(file=rig.text, width=200), 1, FPS, 3.0, driver=lambda: "a person", marks=rig.marks, bell=False
        )
        (episode,) = rig.loop.run([EpisodeSpec(0, 0)])
        time_s = episode.columns["control.time"]
        most_s = 4.5  # however late a busy machine sees the end; 150 frames of this robot take 8 s
        assert 2.7 < time_s[-1] - time_s[0] < most_s
        assert episode.frames < 100
        result = RecordResult(tmp_path, tmp_path)
        result.count(episode, FPS)
        assert 2.7 < result.simulated_s < most_s
        assert result.kept_fps is not None
        assert result.kept_fps <= 25
        found = re.search(r"The robot keeps (\d+) of the 50 frames a second", rig.text.getvalue())
        assert found
        assert 5 < int(found[1]) <= 25
        assert "last: timeout" in status.line().plain


def test_a_run_that_is_dropped_leaves_the_robot_alone(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.0)) as rig:
        run = rig.loop.run([EpisodeSpec(0, 0), EpisodeSpec(1, 1)])
        next(run)
        run.close()
        sent = rig.arm.sent
        assert not np.any(rig.host.running)
        rig.host.stop(np.zeros(1, np.intp))
        assert rig.arm.sent == sent
