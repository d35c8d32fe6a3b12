"""Arms at other rates than their own: they move freely without an alarm, and stop where they press."""

from typing import Any

import numpy as np
import pytest
from lerobot.robots.config import RobotConfig
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Shape
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur import MODELS, ur
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from tests.cases import each_case

# Ticks and physics steps a second.
RATES = ((25, 500), (25, 150), (150, 150), (100, 200), (100, 500), (125, 500), (250, 500), (500, 500), (500, 1000))
BOX = (Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8),)
POSTURES, LIGHT_N, MOST_FREE_N = 6, 20.0, 80.0


def start(n: int, control_hz: int, physics_hz: int, fixtures: tuple[Shape, ...] = ()) -> Simulation:
    arm = Simulation(UR5Config(control_hz=control_hz, physics_hz=physics_hz), n, threads=1, fixtures=fixtures)
    arm.reset(np.arange(n), [TableScene("empty", (), arm.body.arm.home)] * n, [0] * n)
    return arm


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize(("control_hz", "physics_hz"), RATES)
def test_at_any_rates_free_goals_succeed_and_press_on_nothing(control_hz: int, physics_hz: int) -> None:
    arm, rng, codes, most = start(POSTURES, control_hz, physics_hz), np.random.default_rng(1), [], 0.0
    for sim in range(POSTURES):
        turn = rng.uniform(-1.0, 1.0, 6) * (1.5, 0.2, 0.4, 1.0, 1.0, 1.0)
        posture = tuple(np.asarray(arm.body.arm.home[:6]) + turn)
        assert arm.controller.submit(sim, BrainCommand("free", joint_target=posture)) is None
    while arm.controller.busy.any():
        report = arm.step(None)
        assert not report.watchdog.any()
        most = max(most, float(arm.controller.force.max()))
        codes += [result.code for results in report.results.values() for result in results]
    assert codes == [ResultCode.SUCCEEDED] * POSTURES
    assert most < MOST_FREE_N


@pytest.mark.parametrize("name", MODELS)
def test_at_the_lowest_rate_the_last_joint_turns_at_full_speed_without_an_alarm(name: str) -> None:
    body = ur(name)
    hz = body.least_control_hz
    config: Any = RobotConfig.get_choice_class(name)
    arm = Simulation(config(control_hz=hz, physics_hz=10 * hz, fps=25), 1, threads=1)
    arm.reset(np.arange(1), [TableScene("empty", (), arm.body.arm.home)], [0])
    posture = np.array(arm.body.arm.home[:6])
    posture[5] += 5.5
    assert arm.controller.submit(0, BrainCommand("fast", joint_target=tuple(posture))) is None
    codes, most = [], 0.0
    while not codes:
        report = arm.step(None)
        assert not report.watchdog.any()
        most = max(most, float(arm.controller.velocity[0, 5]))
        codes = [result.code for results in report.results.values() for result in results]
    assert codes == [ResultCode.SUCCEEDED]
    assert most > 0.99 * body.limits.velocity[5]


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize(("control_hz", "physics_hz"), RATES)
def test_at_any_rates_an_arm_that_presses_on_something_stops(control_hz: int, physics_hz: int) -> None:
    arm = start(1, control_hz, physics_hz, BOX)
    felt, action = arm.world.sensor("force_fixture_0")[0], arm.cerebellum.command.copy()
    touched = False
    for _ in range(60):
        action[0, 0] += 0.3 / arm.rates.fps
        report = arm.step(action)
        touched |= bool(felt.any())
        if report.watchdog[0]:
            break
    assert touched
    assert report.watchdog[0] & Watchdog.FORCE
    assert report.mode[0] == Mode.FAULT
    for _ in range(20):
        arm.step(None)
    assert np.linalg.norm(felt) < LIGHT_N


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize("kicked", range(6))
@pytest.mark.parametrize(("control_hz", "physics_hz"), [(25, 150), (150, 150), (25, 500)])
def test_at_any_rates_that_are_accepted_a_kick_dies_down(control_hz: int, physics_hz: int, kicked: int) -> None:
    arm = start(1, control_hz, physics_hz)
    there = arm.cerebellum.command.copy()
    arm.physics[1][0, kicked] += 1.0
    for _ in range(3 * arm.rates.fps):
        report = arm.step(there)
    assert report.mode[0] == Mode.TRACKING
    assert np.abs(arm.cerebellum.reading.velocity).max() < 1e-3


def test_setpoints_at_the_lowest_rate_are_reached_and_stay_there() -> None:
    arm = start(1, 25, 500)
    there = arm.cerebellum.command.copy()
    for way in (0.3, 0.0):
        for _ in range(3 * arm.rates.fps):
            arm.step(there + way * np.array([1, 1, -1, 1, 1, 1, 0]))
    assert np.abs(arm.cerebellum.command - there)[0, :6].max() < 1e-6


PAN, ROLL = 0, 4  # joints of an SO-101: of the smallest accelerations, and of the largest


def turning(joint: int, ways: NDArray[np.float64], **options: Any) -> tuple[Simulation, NDArray[np.float64]]:
    """Return SO-101 with a joint so far from the end of its range, and setpoints of that end."""
    arm = Simulation(SO101Config(fps=10, **options), len(ways), threads=1)
    end = np.tile(arm.body.need(Arm).home, (len(ways), 1))
    end[:, joint] = arm.body.limits.upper[joint]
    starts = end.copy()
    starts[:, joint] -= ways
    scenes = [TableScene("empty", (), tuple(row)) for row in starts.tolist()]
    arm.reset(np.arange(len(ways)), scenes, [0] * len(ways))
    arm.controller.arm_limits["keeps_clear"] = False  # the table is near
    return arm, end


def resume(arm: Simulation, setpoints: NDArray[np.float64], waits: NDArray[np.int64]) -> float:
    """Send setpoints so many ticks after the first stop begins; return the hardest brake until then, as a share."""
    since, hardest = 0, 0.0
    while since <= waits.max():
        since += bool(since or (arm.modes == Mode.STOPPING).any())
        hardest = max(hardest, -float(arm.controller.acceleration[:, ROLL].min()))
        arm.bridge.send(setpoints, waits == since)
        arm.bridge.advance_ticks(1)
    return hardest / arm.body.limits.stop_deceleration[ROLL]


@pytest.mark.parametrize(("control_hz", "jerk_limits"), [(100, True), (500, False)])
def test_a_stream_that_goes_on_while_an_arm_brakes_as_hard_as_it_can_is_no_fault(
    control_hz: int, jerk_limits: bool
) -> None:
    """It fell silent where the end of a range leaves no room for a gentle brake, and it speeds the arm up again."""
    ticks = np.arange(1, 13) * control_hz // 100
    ways, waits = (values.ravel() for values in np.meshgrid(np.linspace(1.30, 1.36, 25), ticks))
    arm, end = turning(ROLL, ways, control_hz=control_hz, jerk_limits=jerk_limits)
    for _ in range(4):
        assert arm.bridge.send(end).accepted.all()
        arm.bridge.advance_frame()
    assert resume(arm, end, waits) == pytest.approx(1.0)
    assert (arm.cerebellum.take_flags()[1] == Watchdog.COMMAND_AGE).all()


@pytest.mark.parametrize("wait", [1, 2, 3])
def test_a_stream_that_goes_on_when_a_stop_has_just_begun_is_no_fault(wait: int) -> None:
    arm, end = turning(PAN, np.full(1, 3.0), control_hz=100, stale_after_s=0.02)
    for way in (0.0, 0.0, 0.0, -4.0):
        there = end.copy()
        there[:, PAN] += way
        assert arm.bridge.send(there).accepted.all()
        arm.bridge.advance_frame()
    resume(arm, end, np.full(1, wait))
    arm.bridge.advance_frame()
    assert int(arm.cerebellum.take_flags()[1][0]) & ~Watchdog.COMMAND_AGE == 0


RATES_REFUSED = {
    UR5Config: {(60, 60, 30): (60, 180), (50, 50, 50): (50, 150), (50, 50, 10): (50, 150), (10, 500, 10): (50, 500),
                (100, 100, 25): (100, 200), (7, 7, 7): (28, 140), (20, 200, 5): (25, 200)},
    TurtleBot3Config: {(60, 60, 30): (60, 120), (50, 50, 50): (50, 100), (5, 5, 5): (5, 95)},
}  # fmt: skip


@each_case("config", RATES_REFUSED)
def test_rates_at_which_it_would_shake_are_refused_with_the_nearest_that_work(config: type) -> None:
    for (control_hz, physics_hz, fps), near in RATES_REFUSED[config].items():
        with pytest.raises(ConfigError, match=f"control_hz = {near[0]}, physics_hz = {near[1]}") as refused:
            config(control_hz=control_hz, physics_hz=physics_hz, fps=fps)
        assert f"control_hz is {control_hz} and physics_hz is {physics_hz}" in str(refused.value)
        config(control_hz=near[0], physics_hz=near[1], fps=fps)
    # A plant has no physics rate.
    plant = {"clock": "realtime", "plant": "package.module:Class"}
    UR5Config(control_hz=60, physics_hz=60, fps=30, **plant)
    with pytest.raises(ConfigError, match="control_hz is 10"):
        UR5Config(control_hz=10, physics_hz=10, fps=10, **plant)
