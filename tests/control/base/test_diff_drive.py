import math

import numpy as np
import pytest
from bhd_lerobot.control.base.diff_drive import DiffDrive
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from tests.cases import each_case
from tests.control.support import wheel_speeds

DRIVE = turtlebot3_burger().drive
RADIUS, SEPARATION = 0.033, 0.160
# What one encoder count is worth, on the floor and in yaw.
COUNT_M = 2 * math.pi / 4096 * RADIUS
COUNT_RAD = COUNT_M / SEPARATION
HZ = 200


def follow(speed: float, yaw_rate: float, seconds: float) -> DiffDrive:
    """Feed the odometry of one base with the wheel angles of a twist."""
    drive = DiffDrive(DRIVE, 1)
    angles = np.array([(1234.5, -77.7)])
    drive.reset_odometry(np.array([0]), angles)
    rates = np.array([speed - yaw_rate * SEPARATION / 2, speed + yaw_rate * SEPARATION / 2]) / RADIUS
    for tick in range(1, round(seconds * HZ) + 1):
        drive.update_odometry(angles + rates * tick / HZ)
    return drive


@given(twist=arrays(np.float64, (4, 2), elements=st.floats(-3, 3)))
def test_twist_to_wheels_and_back(twist: np.ndarray) -> None:
    np.testing.assert_allclose(DiffDrive(DRIVE, 4).twist_from_wheels(wheel_speeds(twist)), twist, atol=1e-12)


def test_wheels_by_hand() -> None:
    wheels = wheel_speeds(np.array([(0.033, 0.0), (0.0, 1.0), (0.08, 1.0)]))
    turn = 0.08 / 0.033
    np.testing.assert_allclose(wheels, [(1, 1), (-turn, turn), (0, 2 * turn)], atol=1e-12)


@each_case("turn", [0.2, -0.4])
def test_a_coarse_step_goes_along_the_chord_of_its_arc(turn: float) -> None:
    drive = DiffDrive(DRIVE, 1)
    radius = 0.5
    wheels = np.array([radius - SEPARATION / 2, radius + SEPARATION / 2]) * abs(turn) / RADIUS
    drive.update_odometry(wheels[None] if turn > 0 else wheels[None, ::-1])
    x, y, yaw = drive.odometry[0]
    assert yaw == pytest.approx(turn, abs=2 * COUNT_RAD)
    assert math.atan2(y, x) == pytest.approx(turn / 2, abs=2 * COUNT_RAD)


@pytest.mark.law
@each_case(("speed", "rate"), [(0.2, -1.0), (-0.1, 0.7), (0.0, 2.84)])
def test_a_circle_closes(speed: float, rate: float) -> None:
    period = 2 * math.pi / abs(rate)
    seconds = round(period * HZ) / HZ
    exact = rate * seconds
    x, y, yaw = follow(speed, rate, seconds).odometry[0]
    assert yaw == pytest.approx(exact, abs=2 * COUNT_RAD)
    end = speed / rate * math.sin(exact), speed / rate * (1 - math.cos(exact))
    # The heading is off by up to a count all the way around a circle of this radius.
    assert math.hypot(x - end[0], y - end[1]) <= 2 * COUNT_M + 2 * math.pi * abs(speed / rate) * 2 * COUNT_RAD
    half_way = follow(speed, rate, seconds / 2).odometry[0]
    assert half_way[1] == pytest.approx(2 * speed / rate, abs=0.003)


@given(st.lists(arrays(np.float64, (2, 2), elements=st.floats(-0.1, 0.1)), min_size=1, max_size=20))
def test_odometry_at_matches_update_odometry(steps: list[np.ndarray]) -> None:
    drive = DiffDrive(DRIVE, 2)
    angles = np.zeros((2, 2))
    for step in steps:
        angles = angles + step
        asked = drive.odometry_at(angles)
        assert asked.tobytes() == drive.odometry_at(angles).tobytes()  # asking changes nothing
        drive.update_odometry(angles)
        assert drive.odometry.tobytes() == asked.tobytes()
        np.testing.assert_array_equal(drive.odometry_at(angles), drive.odometry)


@given(st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=50))
def test_quantisation_does_not_add_up(steps: list[float]) -> None:
    """However the wheels got there, the distance is that between the angles, to a count."""
    drive = DiffDrive(DRIVE, 1)
    angle = 0.0
    for step in steps:
        angle += step
        drive.update_odometry(np.full((1, 2), angle))
    assert drive.odometry[0, 0] == pytest.approx(angle * RADIUS, abs=COUNT_M * 1.001)
    assert drive.odometry[0, 2] == 0


def test_bases_are_independent_and_reset_alone() -> None:
    both, alone = DiffDrive(DRIVE, 2), DiffDrive(DRIVE, 1)
    for tick in range(1, 50):
        both.update_odometry(np.array([(0.02 * tick, 0.03 * tick), (-0.05 * tick, 0.01 * tick)]))
        alone.update_odometry(np.array([(-0.05 * tick, 0.01 * tick)]))
    assert both.odometry[1].tobytes() == alone.odometry[0].tobytes()
    before = both.odometry[1].tobytes()
    both.reset_odometry(np.array([0]), np.array([(1.0, 2.0)]))
    assert both.odometry[0].tolist() == [0, 0, 0]
    assert both.odometry[1].tobytes() == before
    both.update_odometry(np.array([(1.0, 2.0), (-0.05 * 49, 0.01 * 49)]))
    assert both.odometry[0].tolist() == [0, 0, 0]
