"""Domain randomisation: off is nominal, on stays in its ranges, and what was drawn can be recorded."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.tabletop import Variation
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.latency import MAX_LATENCY
from bhd_lerobot.runs.provenance import scene_from_json, scene_to_json
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.variation import MAX_LATENCY_S, RandomisationConfig, draw_object_changes, draw_variation

ON = RandomisationConfig(enabled=True)
RANGES = [field.name for field in dataclasses.fields(RandomisationConfig) if field.name != "enabled"]


def test_off_is_exactly_nominal_and_draws_nothing() -> None:
    rng, untouched = np.random.default_rng(0), np.random.default_rng(0)
    wild = RandomisationConfig(enabled=False, mass=9.0, latency_s=0.05)
    assert draw_variation(wild, rng) == Variation()
    changes = draw_object_changes(wild, rng)
    assert changes == {"mass": 1.0, "friction": 1.0, "size": (1.0, 1.0, 1.0), "shade": (0.0, 0.0, 0.0)}
    assert rng.random() == untouched.random()


def test_on_with_ranges_of_nothing_is_nominal_too() -> None:
    nothing = RandomisationConfig(enabled=True, **dict.fromkeys(RANGES, 0.0))
    assert draw_variation(nothing, np.random.default_rng(0)) == Variation()
    changes = draw_object_changes(nothing, np.random.default_rng(0))
    assert changes == {"mass": 1.0, "friction": 1.0, "size": (1.0, 1.0, 1.0), "shade": (0.0, 0.0, 0.0)}


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.99), st.floats(0, 2), st.floats(0, 0.05))
def test_what_is_drawn_lies_in_the_ranges(seed: int, share: float, factor: float, latency: float) -> None:
    config = RandomisationConfig(
        enabled=True, mass=factor, friction=factor, size=share, light=share, latency_s=latency, sensor_noise_rad=share
    )
    rng = np.random.default_rng(seed)
    drawn, changes = draw_variation(config, rng), draw_object_changes(config, rng)
    slack = 1 + 1e-12
    assert (1 - share) / slack <= drawn.light <= (1 + share) * slack
    assert max(map(abs, drawn.light_direction)) <= config.light_direction
    assert max(map(abs, drawn.camera_shift)) <= config.camera_m
    assert max(map(abs, (*drawn.camera_turn, *drawn.wrist_turn))) <= config.camera_rad
    assert 0 <= drawn.sensor_noise <= share
    assert 0 <= drawn.latency_s <= latency
    for value in (drawn.finger_friction, changes["mass"], changes["friction"]):
        assert 1 / (1 + factor) / slack <= value <= (1 + factor) * slack
    assert all((1 - share) / slack <= value <= (1 + share) * slack for value in changes["size"])
    assert all(abs(value) <= config.colour for value in changes["shade"])


def test_the_ranges_are_used_to_their_ends_both_ways_alike() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_variation(ON, rng) for _ in range(2000)]
    light = np.array([one.light for one in drawn])
    assert light.min() < 1 - 0.99 * ON.light
    assert light.max() > 1 + 0.99 * ON.light
    assert np.median(light) == pytest.approx(1, abs=0.03)
    assert {round(one.latency_s * 500) for one in drawn} == set(range(6))  # 10 ms at 500 Hz
    # A factor and its inverse are equally likely.
    logs = np.log([draw_object_changes(ON, rng)["mass"] for _ in range(2000)])
    assert logs.max() > 0.99 * math.log(1 + ON.mass)
    assert logs.min() < -0.99 * math.log(1 + ON.mass)
    assert logs.mean() == pytest.approx(0, abs=0.02)


def test_drawing_is_deterministic() -> None:
    for seed in range(20):
        one, two = (np.random.default_rng(seed) for _ in range(2))
        assert draw_variation(ON, one) == draw_variation(ON, two)
        assert draw_object_changes(ON, one) == draw_object_changes(ON, two)
    assert draw_variation(ON, np.random.default_rng(0)) != draw_variation(ON, np.random.default_rng(1))


@pytest.mark.parametrize("task", [PickTask(PickConfig(randomisation=ON), 1, 25), ReachTask(ReachConfig(), 1, 25)])
def test_a_recorded_scene_comes_back_equal(task: PickTask | ReachTask) -> None:
    for seed in range(30):
        scene = task.sample(seed)
        assert scene_from_json(scene_to_json(scene)) == scene
    assert scene.variation != Variation() or task.name == "reach"


@pytest.mark.parametrize("name", RANGES)
@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf, -math.inf])
def test_impossible_ranges_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"randomisation.{name} is {value}; it must be 0 \(off\) or positive"):
        RandomisationConfig(**{name: value})


@pytest.mark.parametrize("name", ["size", "light"])
def test_nothing_shrinks_to_nothing(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"randomisation.{name} is 1.0; it must be below 1"):
        RandomisationConfig(**{name: 1.0})


def test_a_latency_that_no_plant_can_delay_by_is_refused_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match=r"randomisation.latency_s is 0.051; it must be at most 0.05"):
        RandomisationConfig(latency_s=0.051)
    assert MAX_LATENCY_S * UR5Config().control_hz <= MAX_LATENCY


def test_a_delay_may_be_the_same_in_every_episode() -> None:
    fixed = RandomisationConfig(enabled=True, latency_s=0.04, latency_min_s=0.04)
    rng = np.random.default_rng(0)
    assert {draw_variation(fixed, rng).latency_s for _ in range(20)} == {0.04}
    between = RandomisationConfig(enabled=True, latency_s=0.05, latency_min_s=0.03)
    drawn = [draw_variation(between, rng).latency_s for _ in range(200)]
    assert min(drawn) >= 0.03
    assert max(drawn) <= 0.05
    # The least delay changes nothing else that is drawn.
    one = draw_variation(ON, np.random.default_rng(1))
    other = draw_variation(dataclasses.replace(ON, latency_min_s=0.01), np.random.default_rng(1))
    assert dataclasses.replace(one, latency_s=0.0) == dataclasses.replace(other, latency_s=0.0)


def test_a_least_delay_above_the_largest_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"latency_min_s is 0\.02; it must be at most .*latency_s, which is 0\.01"):
        RandomisationConfig(latency_min_s=0.02, latency_s=0.01)
