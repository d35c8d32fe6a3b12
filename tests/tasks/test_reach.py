"""The reach task: scenes that can be done, and its judge on made-up truth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, TableScene, Variation
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.commands import Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.tasks.support import Judged

FPS = 20
ARM = ur5()
KINEMATICS = ArmKinematics(ARM.arm.chain, ARM.limits)
TARGET = (0.5, 0.1, 0.3, 0.0, 1.0, 0.0, 0.0)
SCENE = TableScene("reach", (), ARM.arm.home, target_pose=TARGET)


class Run(Judged):
    def __init__(self, config: ReachConfig | None = None, n: int = 1) -> None:
        super().__init__(ReachTask(config or ReachConfig(), n, FPS), [SCENE] * n)

    def frame(self, away: float | np.ndarray = 0.0, degrees: float = 0.0, **touched: bool) -> np.ndarray:
        """Judge a frame with the tool this far from the target [m, deg]."""
        pose = np.tile(TARGET, (self.n, 1))
        pose[:, 0] += away
        turned = Rotation.from_euler("y", degrees, degrees=True) * Rotation.from_euler("x", 180, degrees=True)
        x, y, z, w = turned.as_quat()
        pose[:, 3:] = w, x, y, z
        flags = {
            name: np.full(self.n, touched.get(name, False))
            for name in ("arm_on_table", "arm_on_object", "self_contact")
        }
        truth = ArmTruth(
            tool_pose=pose,
            object_poses=np.zeros((self.n, MAX_OBJECTS, 7)),
            opening=np.zeros(self.n),
            fingers_on_object=np.zeros((self.n, MAX_OBJECTS), np.bool_),
            **flags,
        )
        return self.judge(truth)


def test_every_target_can_be_reached_and_every_start_is_free() -> None:
    task = ReachTask(ReachConfig(), 1, FPS)
    places = []
    for seed in range(60):
        scene = task.sample(seed)
        start = np.array(scene.posture[:6])
        assert np.abs(start - ARM.arm.home[:6]).max() <= 0.3
        assert scene.posture[6] == ARM.arm.home[6]
        assert KINEMATICS.check(start) == ResultCode.SUCCEEDED
        assert scene.target_pose is not None
        x, y, z, *quaternion = scene.target_pose
        pose = Pose((x, y, z), tuple(quaternion))
        for posture in (start, np.array(ARM.arm.home[:6])):
            found = KINEMATICS.solve(pose.matrix(), posture)
            assert found.code == ResultCode.SUCCEEDED
        assert np.allclose(KINEMATICS.tool(found.postures[0]), pose.matrix(), atol=1e-6)
        places.append((x, y, z))
    spread = np.ptp(places, axis=0)
    assert (spread > [0.4, 0.7, 0.4]).all()  # all over the box, not in one corner of it


def test_randomisation_changes_the_world_and_not_the_task() -> None:
    plain = ReachTask(ReachConfig(), 1, FPS)
    wild = ReachTask(ReachConfig(randomisation=RandomisationConfig(enabled=True)), 1, FPS)
    for seed in range(5):
        one, two = plain.sample(seed), wild.sample(seed)
        assert (one.target_pose, one.posture) == (two.target_pose, two.posture)
        assert one.variation == Variation() != two.variation


def test_without_spread_it_starts_at_home() -> None:
    assert ReachTask(ReachConfig(start_spread_rad=0.0), 1, FPS).sample(3).posture == ARM.arm.home


def test_orientation_counts_and_its_quaternion_s_sign_does_not() -> None:
    run = Run(ReachConfig(hold_s=0.05))
    for degrees in (90, 180, 5, -5):
        run.frame(0.0, degrees)
        assert run.running[0]
        assert run.outcome().details["error_rad"] == pytest.approx(math.radians(abs(degrees)), abs=1e-6)
    run.frame(0.0, 360)
    assert run.events[0] == Event.SUCCESS


@given(st.lists(st.floats(0.006, 0.5), min_size=1, max_size=30))
def test_the_rewards_sum_to_the_share_of_the_way(path: list[float]) -> None:
    run = Run()
    for away in path:
        run.frame(away)
    assert run.rewards[0] == pytest.approx(1 - path[-1] / path[0], abs=1e-9)
    assert run.outcome().score == pytest.approx(min(1.0, max(0.0, run.rewards[0])), abs=1e-9)
    assert run.outcome().details["error_m"] == pytest.approx(path[-1])
