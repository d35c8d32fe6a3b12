"""The brain `dagger`: who drives when, and what learner and expert see."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.commands import Chunk
from bhd_lerobot.errors import ActionError, ConfigError
from bhd_lerobot.policies.baselines import NoopConfig
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.dagger.brain import LEARNER_DRIVES, DaggerBrain, DaggerConfig
from bhd_lerobot.policies.dagger.takeover import (
    ArmCollisionWatch,
    BaseCollisionWatch,
    DisagreementWatch,
    StallWatch,
    collision_watch,
)
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrainConfig
from bhd_lerobot.policies.manipulation.servo import PickServoConfig
from bhd_lerobot.policies.navigation.avoidance import AvoidanceConfig
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerConfig
from bhd_lerobot.registry import check_brain, drives, make_brain, robot_of_brain
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from tests.cases import each_case

BASE = ("x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(36)))
TWIST = ("x.vel", "theta.vel")
JOINTS = tuple(ur5().limits.names)
ARM = (*JOINTS, *(name.replace(".pos", ".vel") for name in JOINTS))
HOME = np.array(ur5().arm.home)
BURGER = turtlebot3_burger()
DRIVEN = RobotFeatures(BASE, TWIST, 10, (), BURGER)
UR = RobotFeatures(ARM, JOINTS, 25, (), ur5())
NO_ADVICE = np.zeros((1, 2))


class Fake(Brain):
    """Always wants the same, and remembers what it received."""

    def __init__(self, name: str, value: float) -> None:
        self.name, self.value = name, value
        self.seen: list[np.ndarray] = []
        self.seeds: list[int] = []

    def bind(self, *_: Any) -> None: ...

    def reset(self, ids: np.ndarray, seeds: list[int], n: int, instructions: Any = ()) -> None:
        self.seeds += seeds

    def act(self, observation: Observation) -> Any:
        assert observation.running is not None
        self.seen.append(observation.running.copy())
        return np.full((len(observation.state), 2), self.value)

    def parameters(self) -> dict[str, Any]:
        return {"type": self.name, "value": self.value}


def config(**values: Any) -> DaggerConfig:
    nothing = {"collision_s": None, "stall_s": None}
    return DaggerConfig(NoopConfig(), GapFollowerConfig(), **{**nothing, **values})


def base(n: int = 1, speed: float = 0.0, ranges: float = 3.5) -> Observation:
    state = np.full((n, len(BASE)), ranges)
    state[:, 0], state[:, 1] = speed, 0.0
    return Observation(BASE, state, running=np.ones(n, np.bool_))


def arm(q: np.ndarray, velocity: float | np.ndarray = 0.0) -> Observation:
    return Observation(ARM, np.concatenate([q, np.zeros(7) + velocity])[None], running=np.ones(1, np.bool_))


def made(n: int = 1, **values: Any) -> tuple[DaggerBrain, Fake, Fake]:
    learner, expert = Fake("learner", 0.1), Fake("expert", 0.2)
    brain = DaggerBrain(config(**values), learner, expert)
    brain.bind(DRIVEN)
    brain.reset(np.arange(n), list(range(n)), n)
    return brain, learner, expert


@pytest.mark.law
def test_the_expert_drives_to_the_end_or_for_hold_s_and_has_seen_everything() -> None:
    brain, learner, expert = made(patience_s=0.5)
    actions, taken = [], []
    for _ in range(9):
        actions.append(brain.act(base())[0, 0])
        taken.append(bool(brain.interventions()[0]))
    assert taken == [False] * 5 + [True] * 4
    assert actions == [0.1] * 5 + [0.2] * 4
    assert brain.causes() == ("time is up",)
    assert (len(learner.seen), len(expert.seen)) == (6, 9)  # the learner acts no more; its sixth action is not used
    brain, learner, expert = made(patience_s=0.3, hold_s=0.2)
    taken = [bool([brain.act(base()), brain.interventions()[0]][1]) for _ in range(12)]
    assert taken == [bool(one) for one in (0, 0, 0, 1, 1, 0, 0, 0, 1, 1, 0, 0)]
    assert len(learner.seen) == len(expert.seen) == 12


def test_an_expert_with_a_plan_says_what_it_does_where_it_drives() -> None:
    class Planner(Fake):
        has_plan = True

        def subtasks(self) -> list[str]:
            return ["go left"]

    brain = DaggerBrain(config(patience_s=0.1), Fake("learner", 0.1), Planner("expert", 0.2))
    brain.bind(DRIVEN)
    brain.reset(np.arange(1), [0], 1)
    said = []
    for _ in range(2):
        brain.act(base())
        said += brain.subtasks()
    assert brain.has_plan
    assert said == [LEARNER_DRIVES, "go left"]


def test_what_does_not_fit_together_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"brain\.learner\.type is 'dagger' itself"):
        DaggerConfig(config(), GapFollowerConfig())
    with pytest.raises(ConfigError, match=r"brain\.learner\.stream is true"):
        DaggerConfig(LearnedBrainConfig("x", stream=True), GapFollowerConfig())
    both = DaggerConfig(AvoidanceConfig(), PickServoConfig())
    for robot, message in (
        (UR5Config(), r"brain\.learner\.type is 'avoidance', which needs a drive and a lidar; robot\.type is 'ur5'"),
        (TurtleBot3Config(), r"brain\.expert\.type is 'pick_servo', which needs an arm and a gripper; robot"),
    ):
        assert not drives(both, robot.type)
        with pytest.raises(ConfigError, match=message):
            check_brain("brain", both, robot)
    one = DaggerConfig(NoopConfig(), PickServoConfig())
    assert [name for name in ("turtlebot3", "ur5") if drives(one, name)] == ["ur5"]


@each_case(
    ("name", "goals"), [("pick", PickBrainConfig), ("reach", ReachBrainConfig), ("language", LanguageBrainConfig)]
)
def test_a_brain_that_gives_goals_is_refused_when_the_options_are_read_and_when_it_is_made(name, goals):
    learns, advises = DaggerConfig(goals(), PickServoConfig()), DaggerConfig(NoopConfig(), goals())
    for who, settings in (("learner", learns), ("expert", advises)):
        message = rf"brain\.{who}\.type is '{name}', which gives goals.*pick_servo.*reach_servo.*tool_pose"
        for use in (robot_of_brain, make_brain):
            with pytest.raises(ConfigError, match=message):
                use(settings)


def test_a_learner_that_gives_chunks_is_refused_by_name() -> None:
    brain, learner, _ = made()
    learner.act = lambda _: Chunk(np.zeros((2, 1, 2)))  # type: ignore[method-assign]
    with pytest.raises(ActionError, match=r"brain\.learner is 'learner', which gave Chunk"):
        brain.act(base())


def test_a_robot_whose_collisions_it_cannot_foresee_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"not of a robot with the actions a\.pos.*--brain\.collision_s=null"):
        collision_watch(0.5, RobotFeatures(("a.pos",), ("a.pos",), 10))
    with pytest.raises(ConfigError, match=r"not known of tool\.x"):
        DisagreementWatch(0.1, 1, RobotFeatures(("tool.x",), ("tool.x",), 10))


@pytest.mark.law
def test_a_base_that_drives_at_a_wall_is_about_to_collide_and_one_that_stands_or_backs_off_is_not() -> None:
    watch = BaseCollisionWatch(0.5, DRIVEN, BURGER)
    seen = base()
    seen.state[0, 2] = 0.15  # straight ahead, 0.08 m before the robot's front
    for speed, turn, expected in [(0.22, 0.0, True), (0.0, 0.0, False), (-0.1, 0.0, False), (0.05, 0.0, False)]:
        assert watch.check(seen, np.array([[speed, turn]]), NO_ADVICE).tolist() == [expected], (speed, turn)
    assert not watch.check(base(), np.array([[0.22, 0.0]]), NO_ADVICE).any()
    aside = base()
    aside.state[0, 2 + 4] = 0.15  # 40 degrees to the left: it is hit by a left bend, and not by a right one
    bends = [watch.check(aside, np.array([[0.22, turn]]), NO_ADVICE).tolist() for turn in (1.2, -1.2)]
    assert bends == [[True], [False]]


def test_an_arm_that_falls_to_the_table_is_about_to_collide_and_one_that_rises_is_not() -> None:
    watch = ArmCollisionWatch(UR, ur5().arm)
    down = np.zeros(7)
    down[1] = 1.0  # the shoulder leans forward
    low = HOME + np.array([0, 0.40, 0, 0, 0, 0, 0])
    assert not watch.check(arm(HOME), HOME[None], NO_ADVICE).any()
    # The same posture: what counts is where it can come to rest.
    fast, slow = 2.5 * down, 0.02 * down
    assert watch.check(arm(low, fast), low[None] + 0.1 * down, NO_ADVICE).all()
    assert not watch.check(arm(low, slow), low[None] + 0.0008 * down, NO_ADVICE).any()
    assert not watch.check(arm(low, -fast), low[None] - 0.1 * down, NO_ADVICE).any()


@pytest.mark.parametrize(("speed", "stalls"), [(0.0, True), (0.005, True), (0.2, False)])
def test_a_base_that_gets_nowhere_stalls(speed: float, stalls: bool) -> None:
    watch = StallWatch(20, DRIVEN)
    watch.restart(np.arange(1), 1)
    looks = [bool(watch.check(base(speed=speed), np.zeros((1, 2)), NO_ADVICE)[0]) for _ in range(30)]
    assert not any(looks[:20])
    assert looks[20] == stalls
    watch.restart(np.arange(1), 1)
    assert not watch.check(base(speed=speed), np.zeros((1, 2)), NO_ADVICE)[0]


def test_an_arm_that_turns_one_joint_does_not_stall() -> None:
    watch = StallWatch(10, UR)
    for turning, stalls in [(0.02, False), (0.0, True)]:
        watch.restart(np.arange(1), 1)
        looks = [watch.check(arm(HOME + turning * k), HOME[None], NO_ADVICE)[0] for k in range(12)]
        assert bool(looks[-1]) == stalls


def test_disagreement_counts_only_if_it_lasts() -> None:
    watch = DisagreementWatch(0.25, 3, DRIVEN)
    watch.restart(np.arange(1), 1)
    wide = 2 * 2.84 * 0.3  # rad/s, 0.3 of the range of the yaw rate
    looks = []
    for turn in (wide, wide, 0.0, wide, wide, wide, wide):
        looks.append(bool(watch.check(base(), np.zeros((1, 2)), np.array([[0.0, turn]]))[0]))
    assert looks == [False, False, False, False, False, True, True]
