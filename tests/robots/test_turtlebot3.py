"""The TurtleBot3 as LeRobot sees it: bad actions, stops, noise, options, time."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from lerobot.utils.errors import DeviceNotConnectedError

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.errors import ActionError, CommandRefusedError, ConfigError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.sim.frames import run_base_frames
from tests.cases import each_case

GO = {"x.vel": 0.2, "theta.vel": 0.0}


def make(tmp_path: Path, **options) -> TurtleBot3:
    return TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, **options))


@pytest.fixture
def robot(tmp_path):
    with make(tmp_path, arena="empty") as robot:
        yield robot


@pytest.mark.law
def test_bad_actions_are_refused_and_nothing_happens(robot):
    before = robot.host.physics_state
    now = robot.host.bridge.now_ns
    for action, message in (
        ({"x.vel": 0.1}, "lacks 'theta.vel'"),
        ({"x.velo": 0.1, "theta.vel": 0.0}, "Did you mean 'x.vel'"),
        ({**GO, "y.vel": 0.0}, "Unknown action key 'y.vel'"),
        ({"x.vel": math.nan, "theta.vel": 0.0}, "'x.vel' is nan"),
        ({"x.vel": 0.1, "theta.vel": math.inf}, "'theta.vel' is inf"),
        ({"x.vel": -math.inf, "theta.vel": 0.0}, "'x.vel' is -inf"),
        ({"x.vel": "fast", "theta.vel": 0.0}, "not a number"),
        ({"x.vel": None, "theta.vel": 0.0}, "not a number"),
        ([0.1, 0.0], "dict"),
    ):
        with pytest.raises(ActionError, match=message):
            robot.send_action(action)
    assert np.array_equal(robot.host.physics_state, before)
    assert robot.host.bridge.now_ns == now


def test_what_runs_an_action_is_compiled_before_the_first_one(tmp_path, monkeypatch):
    """It may take half a minute: an episode of `lerobot-record`, which is timed by the wall clock, would be over."""
    monkeypatch.delitem(vars(run_base_frames), "compiled", raising=False)
    with make(tmp_path, arena="empty") as robot:
        before = vars(run_base_frames)["compiled"]
        robot.send_action(GO)
        assert vars(run_base_frames)["compiled"] is before


def test_out_of_range_actions_are_limited_in_the_return_value(robot):
    for _ in range(20):
        applied = robot.send_action({"x.vel": 1e9, "theta.vel": 0.0})
    assert applied == {"x.vel": 0.22, "theta.vel": 0.0}
    for _ in range(20):
        applied = robot.send_action({"x.vel": 0.0, "theta.vel": -1e300})
    assert applied["theta.vel"] == -2.84
    measured = robot.get_observation()
    assert measured["theta.vel"] == pytest.approx(-2.84, abs=0.02)


def test_the_returned_action_is_what_the_base_was_commanded(robot):
    # Jerks of 17.5 m/s^3 and 22.4 rad/s^3 give in a tenth of a second 0.0875 m/s, if it need not end at 0.1, and 0.112
    # rad/s.
    applied = robot.send_action({"x.vel": 0.1, "theta.vel": 1.0})
    assert applied["x.vel"] == pytest.approx(0.079, abs=0.002)
    assert applied["theta.vel"] == pytest.approx(0.1176, abs=1e-4)
    applied = robot.send_action({"theta.vel": 1.0, "x.vel": 0.1})  # keys are names, in any order
    assert applied["x.vel"] == 0.1
    assert list(applied) == ["x.vel", "theta.vel"]
    assert applied == dict(zip(robot.action_names, robot.host.cerebellum.command[0], strict=True))


def test_true_speeds_stay_within_five_per_cent_of_the_limits():
    base = Simulation(TurtleBot3Config(beams=36, arena="empty"))
    drive, (speed, turn) = base.body.drive, base.body.limits.velocity
    rng = np.random.default_rng(0)
    full = np.array([speed, turn])
    streams = {
        "start": [[speed, 0]] * 10,
        "reversals": [[speed, 0], [speed, 0], [-speed, 0], [-speed, 0]] * 6,
        "turns": [[0, turn], [0, turn], [0, -turn], [0, -turn]] * 4,
        "corners": rng.choice([-1, 1], (60, 2)) * full,
        "random": rng.uniform(-full, full, (60, 2)),
    }
    arena = make_arena("empty", 0, robot_radius=base.body.drive.radius)
    for name, stream in streams.items():
        base.reset(np.zeros(1, np.intp), [arena], [0])
        fastest = np.zeros(3)
        for action in stream:
            base.bridge.send(np.array([action], float))
            for _ in range(20):
                base.bridge.advance_ticks(1)
                wheels = np.abs(base.cerebellum.reading.velocity).max()
                seen = [np.hypot(*base.world.qvel[0, :2]), abs(base.world.qvel[0, 5]), wheels]
                fastest = np.maximum(fastest, seen)
        assert (fastest <= 1.05 * np.array([speed, turn, drive.max_wheel_speed])).all(), (name, fastest)


@pytest.mark.law
def test_emergency_stop_is_latched_until_reset_and_activate(robot):
    for _ in range(10):
        robot.send_action(GO)
    for call in (make(robot.calibration_dir).estop, make(robot.calibration_dir).reset):
        with pytest.raises(DeviceNotConnectedError):
            call()
    robot.estop()
    for _ in range(3):  # 0.3 s
        with pytest.raises(CommandRefusedError, match="emergency stop is latched"):
            robot.send_action(GO)
    assert abs(robot.get_observation()["x.vel"]) < 1e-3
    with pytest.raises(CommandRefusedError, match="emergency stop"):
        robot.activate()
    robot.reset()
    with pytest.raises(CommandRefusedError, match="activate"):
        robot.send_action(GO)
    robot.activate()
    assert robot.send_action(GO)["x.vel"] == pytest.approx(0.0919, abs=1e-4)
    with pytest.raises(CommandRefusedError):
        robot.reset()  # nothing to clear


@each_case(
    ("options", "message"),
    [
        ({"fps": 7}, "valid values of fps: 4, 5, 8, 10"),
        ({"fps": 0}, "positive whole number"),
        ({"physics_hz": 300}, "control_hz"),
        ({"beams": 7}, "must divide 360"),
        ({"beams": 0}, "must divide 360"),
        ({"clock": "lockstop"}, "Did you mean 'lockstep'"),
        ({"arena": "randm"}, "Did you mean 'random'"),
        ({"lidar_noise_std": -0.1}, "noise_std of the lidar"),
        ({"lidar_noise_std": math.nan}, "noise_std of the lidar"),
        ({"command_timeout_s": 0}, "does not mean 'off'"),
        ({"camera_width": 0}, "must be positive whole numbers"),
    ],
)
def test_options_that_cannot_be_honoured(options, message):
    with pytest.raises(ConfigError, match=message):
        TurtleBot3Config(**options)


def test_a_scan_lasts_a_fifth_of_a_second(robot):
    seen = []
    for _ in range(7):
        observation = robot.get_observation()
        seen.append(tuple(value for name, value in observation.items() if name.startswith("scan_")))
        robot.send_action(GO)
    fresh = [a != b for a, b in itertools.pairwise(seen)]
    assert fresh == [False, True] * 3
