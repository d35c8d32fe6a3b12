"""The scripted reach: its goals on a made-up target, and a few reaches in the simulator."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import RobotFeatures
from bhd_lerobot.policies.manipulation.reach import ReachBrain, ReachBrainConfig
from bhd_lerobot.rollout.types import Episode
from bhd_lerobot.tasks.reach import ENVIRONMENT, ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Event, episode_seed
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case
from tests.policies.arm_desk import Bench, episodes

TARGET = np.array([0.5, 0.1, 0.3, 0.0, 0.6, 0.8, 0.0])


class Desk(Bench):
    """n targets."""

    failure, message = ResultCode.UNREACHABLE, "no way"

    def __init__(self, n: int = 1, **options: Any) -> None:
        self.targets = np.tile(TARGET, (n, 1))
        super().__init__(ReachBrain(ReachBrainConfig(**options)), self.targets, ENVIRONMENT, ("a",))
        self.begin()


def test_it_asks_for_the_target_once_and_holds() -> None:
    desk = Desk(max_velocity=1.5, max_acceleration=5.0)
    goal = desk.look()[0]
    assert goal.target_pose is not None
    assert goal.target_pose.position == tuple(TARGET[:3])
    assert goal.target_pose.quaternion == pytest.approx(tuple(TARGET[3:]))
    assert (goal.max_velocity, goal.max_acceleration, goal.gripper) == (1.5, 5.0, None)
    assert desk.brain.subtasks()[0] == "move the tool to the target"
    assert desk.look() == {}
    assert desk.end() is None
    assert desk.brain.subtasks()[0] == "hold"
    assert desk.look() == {}


def test_a_quaternion_in_single_precision_is_made_a_unit_again() -> None:
    desk = Desk()
    desk.targets[0, 3:] = np.array([0.1, 0.7, 0.7, 0.1]).astype(np.float32)
    goal = desk.look()[0]
    assert goal.target_pose is not None
    assert np.linalg.norm(goal.target_pose.quaternion) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("attempts", [1, 2, 3])
def test_where_no_way_leads_it_goes_by_way_of_home_and_gives_up_in_the_end(attempts: int) -> None:
    desk = Desk(attempts=attempts)
    desk.look()
    for _ in range(attempts - 1):
        home = desk.end(success=False)
        assert home is not None
        assert home.joint_target == ur5().arm.home[:6]
        again = desk.end()
        assert again is not None
        assert again.target_pose is not None
    assert desk.end(success=False) is None
    assert desk.brain.subtasks()[0] == "give up: no way"
    assert desk.look() == {}


def test_when_even_the_way_home_fails_it_ends_too() -> None:
    desk = Desk(attempts=3)
    desk.look()
    goals = 1
    while desk.end(success=False) is not None:
        goals += 1
        assert goals < 10
    assert desk.brain.subtasks()[0].startswith("give up")


@each_case("target", [[np.nan] * 7, [0] * 7, [0.5, np.nan, 0.3, 0, 1, 0, 0], [np.inf, 0, 0, 0, 1, 0, 0]])
def test_what_is_no_pose_is_not_reached_for(target: list[float]) -> None:
    desk = Desk(2)
    desk.targets[0] = target
    assert set(desk.look()) == {1}
    assert desk.brain.subtasks()[0] == "give up: there is no target pose"
    assert desk.look() == {}


def test_a_speed_that_no_joint_of_the_arm_has_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"brain\.max_velocity is 3\.2; .* 3\.14159 rad/s"):
        ReachBrain(ReachBrainConfig(max_velocity=3.2)).bind(RobotFeatures((), (), 25, ENVIRONMENT, body=ur5()))


def test_with_a_camera_error_it_reaches_as_before_if_it_knows_and_misses_if_not() -> None:
    error = (0.012, -0.009, 0.01)  # 18 mm
    off = RandomisationConfig(enabled=True, camera_error_m=list(error))

    def run(randomisation: RandomisationConfig, brain: ReachBrainConfig) -> list[Episode]:
        seeds = [episode_seed(3, index, "train") for index in range(4)]
        return episodes(ReachBrain(brain), ReachTask, ReachConfig(duration_s=4.0, randomisation=randomisation), seeds)

    right = run(RandomisationConfig(enabled=True), ReachBrainConfig())
    knows, trusts = run(off, ReachBrainConfig(camera_error_m=list(error))), run(off, ReachBrainConfig())
    # To the simulator and the judge the error is nothing: a rule that is wrong by it moves the same, in either world.
    same = run(RandomisationConfig(enabled=True), ReachBrainConfig(camera_error_m=[-one for one in error]))
    for before, one, two, three in zip(right, knows, trusts, same, strict=True):
        assert before.outcome.success
        assert one.outcome.success
        assert len(one.columns["action"]) == len(before.columns["action"])
        assert not two.outcome.success
        assert two.outcome.event == Event.TIMEOUT
        assert two.outcome.details["error_m"] == pytest.approx(np.linalg.norm(error), abs=1e-3)
        assert three.outcome.details["error_m"] == pytest.approx(two.outcome.details["error_m"], abs=1e-6)
