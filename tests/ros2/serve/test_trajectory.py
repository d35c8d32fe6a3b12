"""Joint trajectories of ROS 2, sampled in time."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.errors import ActionError
from bhd_lerobot.ros2.serve.trajectory import JointTrajectory

JOINTS = ("a", "b")
START = np.array([0.1, -0.1])


def point(time_s: float, positions: list[float], velocities: list[float] | None = None, **values: list[float]) -> Any:
    sec = int(time_s)
    stamp = SimpleNamespace(sec=sec, nanosec=round((time_s - sec) * 1e9))
    values = {"accelerations": [], "effort": [], **values}
    return SimpleNamespace(positions=positions, velocities=velocities or [], time_from_start=stamp, **values)


def made(*points: Any, joints: tuple[str, ...] = JOINTS, passed_s: float = 0.0) -> JointTrajectory:
    return JointTrajectory(SimpleNamespace(joint_names=list(joints), points=list(points)), JOINTS, START, passed_s)


@pytest.mark.law
@pytest.mark.parametrize("with_speeds", [False, True])
def test_it_passes_its_points_in_time_and_holds_the_last(with_speeds: bool) -> None:
    speeds = [0.5, 0.5] if with_speeds else None
    rest = [0.0, 0.0] if with_speeds else None
    one = made(point(1.0, [1.0, 2.0], speeds), point(2.5, [0.5, 3.0], rest))
    np.testing.assert_allclose(one.at(0.0), START)
    np.testing.assert_allclose(one.at(1.0), [1.0, 2.0])
    np.testing.assert_allclose(one.at(2.5), [0.5, 3.0])
    np.testing.assert_allclose(one.at(99.0), [0.5, 3.0])
    assert one.duration_s == 2.5
    if with_speeds:
        slope = (one.at(1.0 + 1e-6) - one.at(1.0 - 1e-6)) / 2e-6
        np.testing.assert_allclose(slope, speeds, atol=1e-4)
    else:
        np.testing.assert_allclose(one.at(0.5), (START + np.array([1.0, 2.0])) / 2)


def test_joints_are_found_by_name() -> None:
    one = made(point(1.0, [2.0, 1.0]), joints=("b", "a"))
    np.testing.assert_allclose(one.at(1.0), [1.0, 2.0])


@pytest.mark.law
@pytest.mark.parametrize(
    ("points", "joints", "text"),
    [
        ([], JOINTS, "no point"),
        ([point(1.0, [1.0, 2.0])], ("a", "c"), "has the joints a, c; needed: a, b"),
        ([point(1.0, [1.0])], JOINTS, "does not have 2 positions"),
        ([point(1.0, [1.0, np.nan])], JOINTS, "not finite"),
        ([point(1.0, [1.0, 2.0]), point(1.0, [1.0, 2.0])], JOINTS, "do not rise"),
        ([point(-1.0, [1.0, 2.0])], JOINTS, "do not rise"),
        ([point(1.0, [1.0, 2.0], [0.1, 0.0])], JOINTS, r"velocities of the trajectory's last point are \[0.1, 0.0\]"),
        ([point(1.0, [1.0, 2.0], [-0.1, 0.0])], JOINTS, "trajectory's last point"),
        ([point(1.0, [1.0, 2.0], [0.0])], JOINTS, "point 0 .* 2 velocities, but 1"),
        ([point(1.0, [1.0, 2.0]), point(2.0, [1.0, 2.0], [0.0] * 3)], JOINTS, "point 1 .* 2 velocities, but 3"),
        ([point(1.0, [1.0, 2.0], accelerations=[0.0])], JOINTS, "2 accelerations, but 1"),
        (
            [point(1.0, [1.0, 2.0], [np.inf, 0.0]), point(2.0, [1.0, 2.0])],
            JOINTS,
            "velocities of point 0 .* not finite",
        ),
    ],
)
def test_what_cannot_be_followed_is_refused(points: list[Any], joints: tuple[str, ...], text: str) -> None:
    with pytest.raises(ActionError, match=text):
        made(*points, joints=joints)


@pytest.mark.parametrize("passed_s", [0.2, 0.5, 1.0, 1.5, 2.4])
def test_of_one_that_has_begun_the_rest_is_followed_from_where_the_arm_is(passed_s: float) -> None:
    one = made(point(0.0, [9.0, 9.0]), point(1.0, [1.0, 2.0]), point(2.5, [0.5, 3.0]), passed_s=passed_s)
    np.testing.assert_allclose(one.at(passed_s), START)
    np.testing.assert_allclose(one.at(2.5), [0.5, 3.0])
    if passed_s < 1:
        np.testing.assert_allclose(one.at(1.0), [1.0, 2.0])
    with pytest.raises(ActionError, match=r"ended 1\.5 s ago"):
        made(point(1.0, [1.0, 2.0]), passed_s=2.5)


def test_a_stretch_has_the_order_that_both_its_points_have() -> None:
    rest, full = [0.0, 0.0], {"accelerations": [0.0, 0.0]}
    one = made(
        point(0.0, [0.0, 0.0], rest, **full),
        point(1.0, [1.0, 1.0], rest, **full),
        point(2.0, [0.0, 0.0], rest),
        point(3.0, [1.0, 1.0]),
    )
    share = 0.25
    np.testing.assert_allclose(one.at(share), 10 * share**3 - 15 * share**4 + 6 * share**5)
    np.testing.assert_allclose(one.at(1 + share), 1 - (3 * share**2 - 2 * share**3))
    np.testing.assert_allclose(one.at(2 + share), share)


def test_efforts_are_counted_and_not_used() -> None:
    one = made(point(1.0, [1.0, 2.0], effort=[np.nan, 7.0]))
    np.testing.assert_allclose(one.at(1.0), [1.0, 2.0])
    with pytest.raises(ActionError, match="2 effort, but 1"):
        made(point(1.0, [1.0, 2.0], effort=[7.0]))
