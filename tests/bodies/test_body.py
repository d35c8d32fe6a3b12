import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import Arm, Drive, LidarSpec, Limits, Rates, Shape
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.errors import BhdError, ConfigError
from tests.cases import each_case

WHOLE = st.integers(1, 2000)


@given(fps=WHOLE, ticks=st.integers(1, 50), steps=st.integers(1, 20))
def test_rates_that_divide_are_taken_and_multiply_back(fps: int, ticks: int, steps: int) -> None:
    rates = Rates(fps * ticks * steps, fps * ticks, fps)
    assert rates.fps * rates.ticks_per_frame * rates.steps_per_tick == rates.physics_hz


@given(physics=WHOLE, control=WHOLE, fps=WHOLE)
def test_the_error_about_a_rate_lists_rates_that_would_do(physics: int, control: int, fps: int) -> None:
    if physics % control == 0 and control % fps == 0:
        Rates(physics, control, fps)
        return
    with pytest.raises(ConfigError) as caught:
        Rates(physics, control, fps)
    message = str(caught.value)
    valid = [int(rate) for rate in message.rsplit(": ", maxsplit=1)[-1].rstrip(".").split(", ")]
    if physics % control:
        assert message.startswith(f"control_hz is {control} ")
        possible, wanted = [rate for rate in range(1, physics + 1) if physics % rate == 0], control
    else:
        assert message.startswith(f"fps is {fps} ")
        possible, wanted = [rate for rate in range(1, control + 1) if control % rate == 0], fps
    assert valid == sorted(sorted(possible, key=lambda rate: abs(rate - wanted))[:4])


def limits(**changes: object) -> Limits:
    values = {
        "names": ("x.vel", "theta.vel"),
        "velocity": (0.2, 2.0),
        "acceleration": (1.0, 3.0),
        "stop_deceleration": (2.0, 20.0),
        "command_timeout_s": 0.5,
    }
    return Limits(**{**values, **changes})  # type: ignore[arg-type]


@each_case("bad", [(0.2,), (0.2, 2.0, 1.0), (0.2, 0.0), (-0.2, 2.0), (0.2, math.inf), (math.nan, 2.0)])
@each_case("name", ["velocity", "acceleration", "stop_deceleration"])
def test_limits_are_positive_finite_and_as_many_as_the_names(name: str, bad: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=name):
        limits(**{name: bad})


def test_a_position_has_finite_limits_and_a_velocity_may_go_without() -> None:
    positions = dict.fromkeys(("upper", "stop_jerk", "effort"), (1.0, 2.0)) | {"lower": (-1.0, 0.0)}
    assert limits(**positions).bounds == ((-1.0, 0.0), (1.0, 2.0))
    assert limits().bounds == ((-0.2, -2.0), (0.2, 2.0))
    for name in ("upper", "stop_jerk", "effort"):
        with pytest.raises(ConfigError):
            limits(**{**positions, name: (1.0, math.inf)})
    with pytest.raises(ConfigError, match="each range must be finite"):
        limits(**{**positions, "lower": (-1.0, 3.0)})


def test_a_robot_has_a_drive_or_an_arm_and_names_the_part_that_it_lacks() -> None:
    base, arm = turtlebot3_burger(), ur5()
    assert base.limits == base.need(Drive).limits
    assert arm.joints == (*arm.need(Arm).chain.joints, "gripper")
    for body, part, words in ((base, Arm, "no arm"), (arm, Drive, "no drive"), (arm, LidarSpec, "no lidar")):
        with pytest.raises(ConfigError, match=f"{body.name}.* has {words}"):
            body.need(part)
    both = replace(base, arm=arm.arm)
    assert both.joints == (*arm.joints, *base.joints)
    assert both.limits.names == (*arm.limits.names, *base.limits.names)
    assert both.limits.bounds == tuple(a + b for a, b in zip(arm.limits.bounds, base.limits.bounds, strict=True))
    assert both.limits.command_timeout_s == min(arm.limits.command_timeout_s, base.limits.command_timeout_s)
    for make, words in (
        (lambda: replace(base, drive=None), "neither a drive nor an arm"),
        (lambda: replace(base, arm=ur5(actuation="torque").arm), "on a base and takes torques"),
    ):
        with pytest.raises(ConfigError, match=words):
            make()


@each_case("change", [{"kind": "sphere"}, {"size_x": 0.0}, {"size_y": -1.0}, {"height": 0.0}, {"size_x": math.nan}])
def test_a_shape_is_a_box_or_a_cylinder_of_positive_size(change: dict[str, object]) -> None:
    values = {"kind": "box", "x": 0.0, "y": 0.0, "yaw": 0.0, "size_x": 0.1, "size_y": 0.1, **change}
    with pytest.raises(BhdError):
        Shape(**values)  # type: ignore[arg-type]


LIDAR = LidarSpec(site="lidar", beams=360, range_min=0.12, range_max=3.5, rate_hz=5, noise_std=0.01)


@each_case(
    ("change", "message"),
    [
        *(({name: bad}, f"{name} of the lidar is") for name in ("beams", "rate_hz") for bad in (0, -5, 1.5, True)),
        *(({"noise_std": bad}, "noise_std of the lidar is .*0 .off.") for bad in (-0.01, math.inf, math.nan)),
        *(({"range_min": bad}, "range_min of the lidar is") for bad in (-0.1, 3.5, math.nan)),
        *(({"range_max": bad}, "range_max") for bad in (0.12, math.inf, math.nan)),
        ({"ahead": math.nan}, "ahead of the lidar is nan"),
    ],
)
def test_a_lidar_that_cannot_be_built_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(LIDAR, **change)
