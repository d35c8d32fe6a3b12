"""A UR as LeRobot sees it: features, bad actions, stops, goals beside setpoints, tool space, noise, options."""

import math

import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import TableScene, Variation
from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.errors import CommandRefusedError, ConfigError, RenderingError
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.conformance import check_robot
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.ur import UR5, UR3e, UR5e, UR10e
from tests.cases import each_case

FIRST = np.zeros(1, np.intp)
DOWN = (0.0, 1.0, 0.0, 0.0)


def make(tmp_path, kind=UR5, **options) -> UR5:
    return kind(kind.config_class(calibration_dir=tmp_path, **options))


@pytest.fixture
def robot(tmp_path):
    with make(tmp_path) as robot:
        yield robot


def stay(robot) -> dict[str, float]:
    """Return the action that leaves the robot where it is commanded to be."""
    return dict(zip(robot.action_names, robot.host.to_action(robot.host.cerebellum.command)[0].tolist(), strict=True))


@pytest.mark.parametrize(
    ("kind", "space", "scene"),
    [(UR5, "joint", "empty"), *((kind, "tool", "pick") for kind in (UR5, UR3e, UR5e, UR10e))],
)
def test_it_keeps_the_contract_of_a_lerobot_robot(tmp_path, kind, space, scene):
    with make(tmp_path, kind, action_space=space) as robot:
        action = stay(robot)
    assert check_robot(lambda: make(tmp_path, kind, action_space=space, scene=scene), action, adversarial=True) == ()


@pytest.mark.law
def test_a_setpoint_is_clipped_to_the_range_approached_within_the_limits_and_reached(robot):
    target = stay(robot)
    applied = robot.send_action({**target, "gripper.pos": 99.0, "elbow.pos": 1e9})
    assert applied["gripper.pos"] == 0.085
    # 20 ticks of 2 ms at 10 rad/s^2, each tick's speed being that of its end.
    assert 0 < applied["elbow.pos"] - target["elbow.pos"] <= 10 * 0.002**2 * 20 * 21 / 2 + 1e-9
    target["elbow.pos"] += 0.5
    target["gripper.pos"] = 0.02
    speeds = []
    for _ in range(40):
        applied = robot.send_action(target)
        speeds.append(abs(robot.get_observation()["elbow.vel"]))
    assert applied == pytest.approx(target, abs=1e-6)
    seen = robot.get_observation()
    assert seen["elbow.pos"] == pytest.approx(target["elbow.pos"], abs=1e-3)
    assert seen["gripper.pos"] == pytest.approx(0.02, abs=1e-3)
    assert 0.5 < max(speeds) < math.pi


def test_a_tool_pose_that_cannot_be_taken_is_refused_with_the_reason(tmp_path):
    with make(tmp_path, action_space="tool") as robot:
        before = robot.host.cerebellum.command.copy()
        for name, value, message in (
            ("tool_x.pos", 2.0, "short of the pose"),
            ("tool_z.pos", -0.2, "table"),
            ("tool_qw.pos", 3.0, "length"),
        ):
            with pytest.raises(CommandRefusedError, match=message):
                robot.send_action({**stay(robot), name: value})
            assert np.array_equal(robot.host.cerebellum.command, before)


def test_noise_and_latency_belong_to_the_episode(tmp_path):
    simulation = Simulation(UR5Config(), 2)
    home = simulation.body.arm.home
    wild = TableScene("empty", (), home, variation=Variation(sensor_noise=0.001, latency_s=0.02))
    simulation.reset(np.arange(2), [wild, TableScene("empty", (), home)], [7, 7])
    seen = np.array([simulation.observe().state for _ in range(200)])
    assert np.array_equal(seen[:, 1], np.broadcast_to(seen[0, 1], seen[:, 1].shape))
    assert seen[:, 0, :6].std() > 0
    assert seen[:, 0, :6].std(axis=0) == pytest.approx(np.full(6, 0.001), rel=0.25)
    assert (seen[:, 0, 6] == seen[0, 0, 6]).all()  # the gripper's encoder has none
    simulation.reset(FIRST, [wild], [7])
    assert np.array_equal(simulation.observe().state[0], seen[0, 0])  # the same seed, the same noise


@each_case(
    ("options", "message"),
    [
        ({"action_space": "joints"}, "Did you mean 'joint'"),
        ({"control": "servos"}, "Did you mean 'servo'"),
        ({"control": "impedance"}, "action_space=tool"),
        ({"scene": "pik"}, "Did you mean 'pick'"),
        ({"stale_after_s": 0}, "robot.stale_after_s is 0; it must be positive and finite"),
    ],
)
def test_options_that_cannot_be_honoured(options, message):
    with pytest.raises(ConfigError, match=message):
        UR5Config(**options)


def test_scenes_bring_their_objects_and_their_instruction(tmp_path):
    with make(tmp_path, scene="pick", seed=5) as robot:
        names, values = robot.environment
        assert len(names) == len(values) == 80
        assert robot.instruction
        assert values[names.index("object_0_present")] == 1.0
        height = values[names.index("object_0_height")]
        assert values[names.index("object_0_z")] == pytest.approx(height / 2, abs=1e-3)
    with make(tmp_path, scene="reach") as robot:
        assert len(robot.environment[1]) == 7
    with make(tmp_path) as robot:
        assert robot.environment[0] == ()
        assert robot.instruction == ""


def test_camera_images_where_there_is_opengl(tmp_path):
    robot = make(tmp_path, camera=True, camera_width=64, camera_height=48, scene="pick")
    try:
        robot.connect()
    except RenderingError:
        pytest.skip("no OpenGL here; the message is tested in tests/sim")
    seen = robot.get_observation()
    robot.disconnect()
    assert seen["scene"].shape == seen["wrist"].shape == (48, 64, 3)
    assert seen["scene"].std() > 1
    assert seen["wrist"].std() > 1
    assert not np.array_equal(seen["scene"], seen["wrist"])


@pytest.mark.parametrize("kind", [UR5, UR3e, UR5e, UR10e])
def test_an_impedance_robot_keeps_the_contract_and_follows_tool_poses(tmp_path, kind):
    options = {"kind": kind, "control": "impedance", "action_space": "tool"}
    with make(tmp_path, **options) as robot:
        action = stay(robot)
        action["tool_z.pos"] -= 0.05
        for _ in range(50):
            applied = robot.send_action(action)
        assert applied == pytest.approx(action, abs=1e-6)
        tool = robot.host.truth().tool_pose[0]
        assert tool[:3] == pytest.approx([action[f"tool_{axis}.pos"] for axis in "xyz"], abs=2e-3)
        refusal = robot.host.bridge.submit(BrainCommand("a", gripper=0.0))
        assert refusal is not None
        assert not refusal.success
        with pytest.raises(CommandRefusedError, match="length"):
            robot.send_action({**action, "tool_qw.pos": 3.0})
    assert check_robot(lambda: make(tmp_path, **options), action, adversarial=True) == ()


def test_an_impedance_with_too_much_latency_is_refused():
    simulation = Simulation(UR5Config(control="impedance", action_space="tool"))
    late = TableScene("empty", (), simulation.body.arm.home, variation=Variation(latency_s=0.011))
    with pytest.raises(ConfigError, match=r"latency_s is 0\.011"):
        simulation.reset(FIRST, [late], [0])


def test_a_goal_for_an_unknown_arm_is_refused(robot):
    assert robot.host.body.limits.names == robot.action_names
    for sim in (-1, 1):
        with pytest.raises(ConfigError, match=f"sim is {sim}"):
            robot.host.bridge.submit(BrainCommand("a", gripper=0.05), sim)
