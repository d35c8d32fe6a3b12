"""The time between two episodes of a real robot."""

import io
import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.recording.reset import ResetPhase
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

    def __init__(self, tmp_path: Path, seconds: float, fault_at: int = 0) -> None:
        fault = "disconnect" if fault_at else ""
        arm = MockArm(MockArmConfig(id="arm", calibration_dir=tmp_path, fault=fault, fault_at=fault_at))
        self.arm, self.host = arm, LeRobotHost(arm, FPS, GateConfig())
        arm.connect()
        self.stopped = False
        leader = MockLeaderConfig(id="leader", calibration_dir=tmp_path)
        self.brain = TeleopBrain(TeleopConfig(leader))
        task = FreeTask(FreeConfig("wave", 0.1), 1, FPS)
        self.loop = EpisodeLoop(self.host, task, self.brain)
        self.loop.marks = self.marks = Marks()
        self.text = io.StringIO()
        console = Console(file=self.text, width=100)
        self.loop.before_start = ResetPhase(
            self.host, self.brain, self.marks, seconds, stop=lambda: self.stopped, console=console
        )

    def run(self) -> list[Episode]:
        return list(self.loop.run([EpisodeSpec(0, 0), EpisodeSpec(1, 1)], lambda: self.stopped))

    def close(self) -> None:
        self.brain.close()
        self.host.close()


def test_the_leader_drives_and_nothing_is_recorded(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.5)) as rig:
        episodes = rig.run()
        assert [episode.frames for episode in episodes] == [5, 5]
        assert rig.arm.sent > 5 + 5 + 15
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


def test_a_pause_waits_without_a_time_and_a_fault_ends_it(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.0, fault_at=20)) as rig:
        rig.marks.pause()
        with pytest.raises(RealtimeError, match="the bus does not answer"):
            rig.run()
        assert "Paused. Enter begins episode 1." in rig.text.getvalue()


def test_a_run_that_is_dropped_leaves_the_robot_alone(tmp_path: Path) -> None:
    with closing(Rig(tmp_path, 0.0)) as rig:
        run = rig.loop.run([EpisodeSpec(0, 0), EpisodeSpec(1, 1)])
        next(run)
        run.close()
        sent = rig.arm.sent
        assert not np.any(rig.host.running)
        rig.host.stop(np.zeros(1, np.intp))
        assert rig.arm.sent == sent
