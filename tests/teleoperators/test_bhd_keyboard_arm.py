"""The tool and the joints of an arm moved from a terminal, alone and under LeRobot's command."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.ur import MAX_OPENING
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.start_pose import StartsFromObservation
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.realtime.estop import KEYS as ESTOP_KEYS
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.parts.names import TOOL_NAMES
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.robots.ur import UR5
from bhd_lerobot.rollout.marks import TELEOP_KEYS
from bhd_lerobot.teleoperators.bhd_keyboard_arm import BhdKeyboardArm
from bhd_lerobot.teleoperators.config_bhd_keyboard_arm import BhdKeyboardArmConfig
from bhd_lerobot.teleoperators.targets import LEASH_M, LEASH_RAD
from tests.cases import each_case
from tests.teleoperators.keyboard_support import Clock, Person, clock, person  # noqa: F401  fixtures
from tests.waiting import until

FRAME = 0.04  # [s]
DOWN = (0.0, 1.0, 0.0, 0.0)
POSE = dict(zip(TOOL_NAMES, (0.4, 0.1, 0.3, *DOWN, 0.085), strict=True))
JOINT_ACTIONS = UR5Config().body().limits.names
JOINTS = dict(zip(JOINT_ACTIONS, (*UR5Config().body().arm.home,), strict=True))
TOOL_KEYS = ("w", "a", "r", "u", "i", "j"), ("s", "d", "f", "o", "k", "l")  # along and about x, y, z, and back
JOINT_KEYS = "asdfhj", "zxcvnm"


@pytest.fixture
def make(tmp_path, clock: Clock, person: Person) -> Iterator[Any]:  # noqa: F811
    """Return connected teleoperators; what they are given is their configuration."""
    made: list[BhdKeyboardArm] = []

    def connected(**options: Any) -> BhdKeyboardArm:
        made.append(BhdKeyboardArm(BhdKeyboardArmConfig(calibration_dir=tmp_path, **options), clock))
        made[-1].connect()
        return made[-1]

    yield connected
    for one in made:
        one.disconnect()


def pose(action: dict[str, float]) -> tuple[np.ndarray, Rotation]:
    values = np.array([action[name] for name in TOOL_NAMES])
    return values[:3], Rotation.from_quat(values[3:7], scalar_first=True)


def test_each_key_moves_the_tool_along_or_about_its_axis(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    teleop = make(speed=0.05, turn_speed=0.3)
    assert isinstance(teleop, StartsFromObservation)
    for sign, keys in zip((1, -1), TOOL_KEYS, strict=True):
        for axis, key in enumerate(keys):
            teleop.start_from(POSE)
            person.press(key, teleop)
            clock.now += FRAME
            action = teleop.get_action()
            assert list(action) == list(teleop.action_features) == list(TOOL_NAMES)
            position, rotation = pose(action)
            moved = np.zeros(6)
            moved[axis] = sign * FRAME * (0.05 if axis < 3 else 0.3)
            start, down = pose(POSE)
            assert np.allclose(np.concatenate([position - start, (rotation * down.inv()).as_rotvec()]), moved), key
            assert action["gripper.pos"] == 0.085


def test_each_key_turns_its_joint(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    teleop = make(action_space="joint", turn_speed=0.3)
    for sign, keys in zip((1, -1), JOINT_KEYS, strict=True):
        for joint, key in enumerate(keys):
            teleop.start_from(JOINTS)
            person.press(key, teleop)
            clock.now += FRAME
            action = teleop.get_action()
            turned = dict(JOINTS)
            turned[JOINT_ACTIONS[joint]] += sign * FRAME * 0.3
            assert list(action) == list(teleop.action_features)
            assert action == pytest.approx(turned)


def test_joints_and_opening_are_those_of_the_arm(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    arm = UR5Config().body().arm
    names = tuple(f"j{number}" for number in range(6))
    arm = replace(arm, chain=replace(arm.chain, joints=names), gripper=replace(arm.gripper, max_opening=0.05))
    teleop = make(action_space="joint")
    teleop.start_from(
        {**dict(zip((f"{name}.pos" for name in names), arm.home, strict=False)), "gripper.pos": 0.0},
        replace(UR5Config().body(), arm=arm),
    )
    person.press("g", teleop)
    clock.now += FRAME
    assert list(teleop.get_action()) == [*(f"{name}.pos" for name in names), "gripper.pos"]
    for _ in range(30):
        clock.now += FRAME
        action = teleop.get_action()
    assert action["gripper.pos"] == 0.05


@each_case("joints", [4, 5, 7])
def test_keys_turn_the_joints_that_an_arm_has(make: Any, clock: Clock, person: Person, joints: int) -> None:  # noqa: F811
    """One without a gripper has no opening."""
    names = tuple(f"j{number}" for number in range(joints))
    arm = SimpleNamespace(chain=SimpleNamespace(joints=names), gripper=None)
    teleop = make(action_space="joint", turn_speed=0.3)
    teleop.learn(SimpleNamespace(arm=arm))
    start = dict.fromkeys((f"{name}.pos" for name in names), 0.5)
    for sign, keys in zip((1, -1), ("asdfhjk", "zxcvnm,"), strict=True):
        for joint, key in enumerate(keys):
            teleop.start_from(start)
            person.press(key, teleop)
            clock.now += FRAME
            turned = {name: 0.5 + sign * FRAME * 0.3 * (name == f"j{joint}.pos") for name in start}
            assert teleop.get_action() == pytest.approx(turned)
            assert list(teleop.action_features) == list(turned)


@each_case("space", ["tool", "joint"])
def test_keys_of_the_emergency_stop_and_of_the_recorder_only_stop(make: Any, space: str) -> None:
    teleop = make(action_space=space)
    for key in [chr(key) for sent in (ESTOP_KEYS, *(one.sent for one in TELEOP_KEYS)) for key in sent]:
        assert key not in teleop.motions
        assert not teleop.adjust(key)


def test_the_tool_moves_while_a_key_is_held_and_rests_after_it(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    """A target that goes on by the same step in every frame, until the hold time is over or another key stops it."""
    teleop = make(speed=0.05, hold_s=0.61)
    teleop.start_from(POSE)
    clock.now += 60.0  # the program was held up: it does not catch up
    person.press("w", teleop)
    assert teleop.get_action()["tool_x.pos"] == pytest.approx(0.4 + 0.05 * 0.1)
    for stop in ("", "k\x1b", " "):
        teleop.start_from(POSE)
        x = []
        for frame in range(40):
            if frame in (0, 13):  # a repeat after 0.52 s
                person.press("w", teleop)
            if frame == 20 and stop:
                person.press(stop, teleop)
            clock.now += FRAME
            action = teleop.get_action()
            teleop.observe(action)
            x.append(action["tool_x.pos"])
        steps = np.diff([0.4, *x])
        moving = 20 if stop else 28  # 13 frames to the repeat, and 0.61 s
        assert np.allclose(steps[:moving], 0.05 * FRAME)
        assert np.allclose(steps[moving:], 0.0)


def test_the_target_stays_near_an_arm_that_does_not_follow(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    for space, measured, keys in (("tool", POSE, "wi"), ("joint", JOINTS, "a")):
        teleop = make(action_space=space)
        teleop.start_from(measured)
        for key in keys:
            for _ in range(60):
                person.press(key, teleop)
                clock.now += FRAME
                action = teleop.get_action()
        if space == "tool":
            (position, rotation), (start, down) = pose(action), pose(measured)
            assert np.allclose(position - start, [LEASH_M, 0, 0])
            assert np.allclose((rotation * down.inv()).as_rotvec(), [0, LEASH_RAD, 0])
        else:
            assert action["shoulder_pan.pos"] - measured["shoulder_pan.pos"] == pytest.approx(LEASH_RAD)
        clock.now += 1.0
        assert teleop.get_action() == action  # and no farther


def test_g_closes_and_opens_the_gripper_at_its_speed(make: Any, clock: Clock, person: Person) -> None:  # noqa: F811
    teleop = make()
    teleop.start_from(POSE)
    for closed in (True, False, True):
        person.press("g", teleop)
        openings = []
        for _ in range(30):
            clock.now += FRAME
            openings.append(teleop.get_action()["gripper.pos"])
        assert openings[-1] == (0.0 if closed else MAX_OPENING)
        assert np.abs(np.diff(openings)).max() <= 0.1 * FRAME + 1e-9
    teleop.start_from({**POSE, "gripper.pos": 0.0})
    person.press("g", teleop)  # closed where it starts: it opens
    clock.now += FRAME
    assert teleop.get_action()["gripper.pos"] > 0


def test_a_gripper_that_may_hold_something_does_not_let_go(make: Any, clock: Clock) -> None:  # noqa: F811
    teleop = make()
    for measured, commanded in ((0.04, 0.03), (0.005, 0.0), (MAX_OPENING - 1e-4, MAX_OPENING - 1e-4)):
        teleop.start_from({**POSE, "gripper.pos": measured})
        assert teleop.get_action()["gripper.pos"] == measured
        for _ in range(5):
            clock.now += 0.1
            action = teleop.get_action()
        assert action["gripper.pos"] == pytest.approx(commanded)


def test_as_a_brain_it_starts_where_the_robot_is_at_an_episode_and_at_a_takeover(
    tmp_path: Path, clock: Clock, person: Person  # noqa: F811
) -> None:  # fmt: skip
    brain = TeleopBrain(TeleopConfig(BhdKeyboardArmConfig(calibration_dir=tmp_path)))
    teleop: BhdKeyboardArm = brain.teleop
    teleop._clock = clock
    names = (*JOINT_ACTIONS, *TOOL_NAMES[:-1])
    body = UR5Config().body()
    brain.bind(RobotFeatures(names, TOOL_NAMES, 1, body=body, robot_type="ur5"))  # which has a frame to answer in
    tool = pose_vectors(ArmKinematics(body.arm.chain, body.limits).tool(np.array(body.arm.home[:6])))
    observation = Observation(names, np.array([[*body.arm.home, *tool]]))
    for _ in range(2):
        brain.reset(np.zeros(1, np.intp), [0], 1)
        person.press("w", teleop)
        x = []
        for _ in range(5):
            x.append(brain.act(observation)[0, 0])  # type: ignore[index]  it gives setpoints
            clock.now += FRAME
        assert np.allclose(x, tool[0] + 0.05 * FRAME * np.arange(5))
    brain.close()
    assert not teleop.is_connected


def test_plus_and_minus_change_the_speeds_up_to_their_limits(
    make: Any, clock: Clock, person: Person, capsys: pytest.CaptureFixture[str]  # noqa: F811
) -> None:  # fmt: skip
    teleop = make(speed=0.05)
    for keys, speed in (("-", 0.045), ("+=", 0.05445), ("+" * 50, 0.25)):
        teleop.start_from(POSE)
        person.press(f"w{keys}", teleop)
        clock.now += FRAME
        assert teleop.get_action()["tool_x.pos"] == pytest.approx(0.4 + speed * FRAME)
    assert "Now 0.250 m/s, 1.000 rad/s." in capsys.readouterr().err


def test_the_tool_starts_at_its_observed_pose_or_where_the_joints_have_it(
    make: Any, clock: Clock, person: Person  # noqa: F811
) -> None:  # fmt: skip
    first = make()
    first.start_from(JOINTS)
    second = make()
    second.start_from({**JOINTS, **{name: first.get_action()[name] for name in TOOL_NAMES}})
    for _ in range(3):
        assert first.get_action() == pytest.approx(second.get_action())
        person.press("w", first)
        until(lambda: second._events)
        clock.now += FRAME
    assert [first.get_action()[name] for name in TOOL_NAMES[:3]] == pytest.approx([0.493, 0.109, 0.282], abs=1e-3)


@each_case(
    ("space", "observation", "message"),
    [
        ("tool", {"x.vel": 0.0, "gripper.pos": 0.0}, "The observation has x.vel, gripper.pos; to move the tool it"),
        ("joint", POSE, "to turn joints it needs shoulder_pan.pos"),
        ("tool", {name: POSE[name] for name in TOOL_NAMES[:-1]}, "needs gripper.pos, too"),
    ],
)
def test_an_observation_without_the_pose_is_refused(tmp_path, space, observation, message):
    teleop = BhdKeyboardArm(BhdKeyboardArmConfig(calibration_dir=tmp_path, action_space=space))
    with pytest.raises(ConfigError, match=message):
        teleop.start_from(observation)


def test_it_finds_the_robot_of_its_process_and_says_what_does_not_fit(make: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="connected are: none"):
        make().get_action()
    with TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, arena="empty")), pytest.raises(
        ConfigError, match=r"the turtlebot3 takes x.vel, theta.vel.*--teleop.type=bhd_keyboard_base"
    ):  # fmt: skip
        make().get_action()
    with UR5(UR5Config(calibration_dir=tmp_path)) as robot:
        with pytest.raises(ConfigError, match=r"give --robot.action_space and --teleop.action_space"):
            make().get_action()
        seen = robot.get_observation()
        action = make(action_space="joint").get_action()
        assert action == pytest.approx({name: seen[name] for name in JOINT_ACTIONS})


@each_case("key", ["w", "f", "o"])
def test_at_the_end_of_the_workspace_the_tool_stops_and_no_action_is_refused(
    make: Any, clock: Clock, person: Person, tmp_path: Path, key: str  # noqa: F811
) -> None:  # fmt: skip
    teleop = make(speed=0.25, turn_speed=1.0)
    with UR5(UR5Config(calibration_dir=tmp_path, action_space="tool")) as robot:
        tools = []
        for _ in range(75):
            robot.get_observation()
            person.press(key, teleop)
            clock.now += FRAME
            action = teleop.get_action()
            robot.send_action(action)
            tools.append([action[name] for name in TOOL_NAMES])
    assert not np.allclose(tools[0], tools[-1], atol=0.1)
    assert np.allclose(tools[-1], tools[-2])
    teleop.disconnect()
