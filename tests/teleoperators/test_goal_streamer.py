"""Goals as setpoints: what a brain that gives goals does to a robot that takes setpoints only."""

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrainConfig
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.ur import UR5
from bhd_lerobot.teleoperators.bhd_brain import BhdBrain, GoalStreamer
from bhd_lerobot.teleoperators.config_bhd_brain import BhdBrainConfig

CONFIG = UR5Config()
ARM, RATES = CONFIG.body(), CONFIG.rates
HOME = np.array(ARM.arm.home)


def drive(tmp_path, brain, frames=125, **options):
    """Let a brain drive a robot as lerobot-record does; return the robot's truth, its scene and the brain."""
    config = BhdBrainConfig(calibration_dir=tmp_path, brain=brain)
    with UR5(UR5Config(calibration_dir=tmp_path, **options)) as robot, BhdBrain(config) as teleop:
        assert list(teleop.action_features) == list(robot.action_features)
        for _ in range(frames):
            robot.get_observation()
            requested = teleop.get_action()
            applied = robot.send_action(requested)
            assert applied == pytest.approx(requested, abs=1e-2)  # goals never ask for more than the limits
        return robot.host.truth(), robot._scene, teleop._brain


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(
    ("brain", "seed", "space"), [(PickBrainConfig(), 0, "joint"), (LanguageBrainConfig(), 1, "tool")]
)
def test_a_pick_brain_picks_through_setpoints(tmp_path, brain, seed, space):
    truth, scene, _ = drive(tmp_path, brain, scene="pick", seed=seed, action_space=space)
    target = scene.target_object
    assert truth.object_poses[0, target, 2] > scene.objects[target].height / 2 + 0.1
    assert truth.fingers_on_object[0].tolist() == [number == target for number in range(5)]


def test_a_reach_brain_reaches_through_setpoints(tmp_path):
    truth, scene, _ = drive(tmp_path, ReachBrainConfig(), frames=80, scene="reach", seed=3)
    assert truth.tool_pose[0, :3] == pytest.approx(scene.target_pose[:3], abs=1e-3)


def test_the_brain_receives_a_refused_goal(tmp_path):
    _, _, brain = drive(tmp_path, LanguageBrainConfig(instruction="pick up the elephant"), frames=3, scene="pick")
    assert "elephant" in brain.plan(0)["problem"]


def test_a_brain_without_its_scene_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="object_0_present"):
        drive(tmp_path, PickBrainConfig(), scene="empty")


def drain(streamer, commands, frames=100, behind=0.0):
    """Feed goals, then let frames go by; return the reference at the end of every frame and the results."""
    references, results = [], []
    measured = HOME.copy()
    for frame in range(frames):
        reference, ended = streamer.frame(commands if frame == 0 else (), measured)
        references.append(reference)
        results += ended
        measured = reference - behind
    return np.array(references), results


@pytest.mark.law
def test_the_stream_is_the_trajectory_of_the_goal():
    goal = BrainCommand("a", target_pose=Pose((0.4, 0.1, 0.3), (0.0, 1.0, 0.0, 0.0)), gripper=0.03)
    references, results = drain(GoalStreamer(ARM, RATES, HOME), [goal])
    assert [(result.task_id, result.code) for result in results] == [("a", ResultCode.SUCCEEDED)]
    speed = np.abs(np.diff(references, axis=0)) * RATES.fps
    assert (speed <= np.array(ARM.limits.velocity) + 1e-9).all()
    assert references[-1, 6] == pytest.approx(0.03)
    assert np.array_equal(references[-1], references[-5])


def test_refusals_and_tolerances_come_back():
    bad = BrainCommand("a", target_pose=Pose((0.4, 0.1, 0.3), (0.0, 2.0, 0.0, 0.0)))
    assert [one.code for one in drain(GoalStreamer(ARM, RATES, HOME), [bad], 2)[1]] == [ResultCode.NOT_NORMALISED]
    far = BrainCommand("a", joint_target=(HOME[0] - 0.5, *HOME[1:6]))
    stuck = np.full(7, 0.2)  # the arm stays behind: something is in its way
    assert [one.code for one in drain(GoalStreamer(ARM, RATES, HOME), [far], 60, stuck)[1]] == [
        ResultCode.PATH_TOLERANCE
    ]
