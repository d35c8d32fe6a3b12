"""Domain randomisation: off is nominal, on stays in its ranges, and what was drawn can be recorded."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.scenes import scene_from_json, scene_to_json
from bhd_lerobot.bodies.tabletop import MAX_LATENCY_S, MAX_OBJECTS, Variation
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.baselines import RandomBrain, RandomConfig
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrainConfig
from bhd_lerobot.policies.manipulation.servo import ServoConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.parts.latency import MAX_LATENCY
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.variation import RandomisationConfig, draw_object_changes, draw_variation
from tests.cases import each_case

ON = RandomisationConfig(enabled=True)
FIXED = ("enabled", "camera_error_m", "camera_shift_m", "camera_turn_rad")
RANGES = [field.name for field in dataclasses.fields(RandomisationConfig) if field.name not in FIXED]


def test_off_and_ranges_of_nothing_are_exactly_nominal_and_off_draws_nothing() -> None:
    off = RandomisationConfig(enabled=False, mass=9.0, latency_s=0.05)
    for config in (off, RandomisationConfig(enabled=True, **dict.fromkeys(RANGES, 0.0))):
        rng, untouched = np.random.default_rng(0), np.random.default_rng(0)
        assert draw_variation(config, rng) == Variation()
        same = {"mass": 1.0, "friction": 1.0, "size": (1.0, 1.0, 1.0), "shade": (0.0, 0.0, 0.0)}
        assert draw_object_changes(config, rng) == {**same, "style": "usual", "marks": ()}
        assert (rng.random() == untouched.random()) == (config is off)


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.99), st.floats(0, 2), st.floats(0, 0.05))
def test_what_is_drawn_lies_in_the_ranges(seed: int, share: float, factor: float, latency: float) -> None:
    config = RandomisationConfig(
        enabled=True,
        mass=factor,
        friction=factor,
        size=share,
        light=share,
        latency_s=latency,
        sensor_noise_rad=share,
        surface=share,
    )
    rng = np.random.default_rng(seed)
    drawn, changes = draw_variation(config, rng), draw_object_changes(config, rng)
    slack = 1 + 1e-12
    assert (1 - share) / slack <= drawn.light <= (1 + share) * slack
    assert max(map(abs, drawn.light_direction)) <= config.light_direction
    assert max(map(abs, drawn.camera_shift)) <= config.camera_m
    assert max(map(abs, (*drawn.camera_turn, *drawn.wrist_turn))) <= config.camera_rad
    assert max(map(abs, drawn.surface)) <= share
    assert 0 <= drawn.sensor_noise <= share
    assert 0 <= drawn.latency_s <= latency
    for value in (drawn.finger_friction, changes["mass"], changes["friction"]):
        assert 1 / (1 + factor) / slack <= value <= (1 + factor) * slack
    assert all((1 - share) / slack <= value <= (1 + share) * slack for value in changes["size"])
    assert all(abs(value) <= config.colour for value in changes["shade"])


def test_a_table_that_keeps_its_colour_leaves_all_other_worlds_as_they_were() -> None:
    rng, again = np.random.default_rng(3), np.random.default_rng(3)
    before = draw_variation(ON, rng)
    assert before.surface == (0.0, 0.0, 0.0)
    after = draw_variation(dataclasses.replace(ON, surface=0.2), again)
    assert dataclasses.replace(after, surface=before.surface) == before
    rng.random(3)  # what the colour took, and nothing where there is none
    assert draw_object_changes(ON, rng) == draw_object_changes(ON, again)


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


def test_a_latency_that_no_plant_can_delay_by_is_refused_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match=r"latency_min_s is 0\.02; it must be at most .*latency_s, which is 0\.01"):
        RandomisationConfig(latency_min_s=0.02, latency_s=0.01)
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


def test_to_the_simulator_and_the_judge_a_camera_error_is_nothing() -> None:
    off = dataclasses.replace(ON, camera_error_m=[0.01, -0.02, 0.1])
    simulation = Simulation(UR5Config(), 2, threads=1)

    def run(randomisation: RandomisationConfig) -> list[Episode]:
        task = PickTask(PickConfig(duration_s=1.0, min_objects=3, randomisation=randomisation), 2, 25)
        loop = EpisodeLoop(simulation, task, RandomBrain(RandomConfig(scale=0.1)))  # it looks at nothing
        return list(loop.run([EpisodeSpec(index, index) for index in range(2)]))

    for right, wrong in zip(run(ON), run(off), strict=True):
        np.testing.assert_array_equal(right.initial_state, wrong.initial_state)
        for key, values in right.columns.items():
            if key == keys.ENVIRONMENT_STATE:
                moved = (wrong.columns[key] - values).reshape(len(values), MAX_OBJECTS, -1)
                there = np.arange(MAX_OBJECTS) < len(right.scene.objects)
                assert np.abs(moved[:, there, 3:6] - (0.01, -0.02, 0.1)).max() < 1e-6
                assert not np.delete(moved, (3, 4, 5), axis=2).any()
                assert not moved[:, ~there].any()
            elif key != keys.INFERENCE_TIME:
                np.testing.assert_array_equal(values, wrong.columns[key], err_msg=key)
        assert right.outcome == wrong.outcome


def test_a_scene_that_was_recorded_before_there_were_camera_errors_has_none() -> None:
    scene = ReachTask(ReachConfig(randomisation=ON), 1, 25).sample(0)
    fields = json.loads(scene_to_json(scene))
    del fields["variation"]["camera_error"]
    assert scene_from_json(json.dumps(fields)) == scene


@each_case(
    "error",
    [(0.0, 0.0), (0.0,) * 4, (), (math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf), (0.0, -0.201, 0.0)],
)
def test_what_no_calibration_is_off_by_is_refused_for_the_task_and_for_the_rules(error: tuple[float, ...]) -> None:
    for make, name in (
        (lambda **one: RandomisationConfig(enabled=True, **one), "randomisation"),
        (ReachBrainConfig, "brain"),
        (PickBrainConfig, "brain"),
        (LanguageBrainConfig, "brain"),
        (ServoConfig, "brain"),
    ):
        message = rf"^{name}.camera_error_m is {re.escape(str(list(error)))}; it must be three numbers, .* -0.2 and 0.2"
        with pytest.raises(ConfigError, match=message):
            make(camera_error_m=list(error))


def test_a_moved_or_wrong_camera_is_so_in_every_episode_and_changes_nothing_else_that_is_drawn() -> None:
    shift, turn, error = (0.02, -0.01, 0.02), (0.05, 0.06, -0.04), (0.01, -0.02, 0.2)
    moved = dataclasses.replace(ON, camera_shift_m=list(shift), camera_turn_rad=list(turn), camera_error_m=list(error))
    for seed in range(10):
        before, after = (PickTask(PickConfig(randomisation=one), 1, 25).sample(seed) for one in (ON, moved))
        assert np.subtract(after.variation.camera_shift, before.variation.camera_shift) == pytest.approx(shift)
        assert np.subtract(after.variation.camera_turn, before.variation.camera_turn) == pytest.approx(turn)
        assert (before.variation.camera_error, after.variation.camera_error) == ((0.0, 0.0, 0.0), error)
        same = {name: getattr(before.variation, name) for name in ("camera_shift", "camera_turn", "camera_error")}
        assert dataclasses.replace(after, variation=dataclasses.replace(after.variation, **same)) == before
        assert scene_from_json(scene_to_json(after)) == after


@each_case(
    "values",
    [
        ({"camera_shift_m": [0.0, 0.0]}, r"camera_shift_m is \[0.0, 0.0\]; it must be three finite numbers \[m\]"),
        ({"camera_turn_rad": [0.0, math.nan, 0.0]}, r"camera_turn_rad is \[0.0, nan, 0.0\]; .* numbers \[rad\]"),
        ({"camera_error_m": [0.0, 0.01, 0.0], "enabled": None}, r"camera_error_m is .* --task.randomisation.enabled=t"),
        ({"camera_turn_rad": [0.1, 0.0, 0.0], "enabled": False}, r"camera_turn_rad is .* --task.randomisation.enabled"),
    ],
)
def test_a_move_that_is_none_or_would_not_be_honoured_is_refused(values: tuple[dict, str]) -> None:
    options, message = values
    with pytest.raises(ConfigError, match=message):
        RandomisationConfig(**{"enabled": True, **options})


def test_a_range_without_randomisation_is_refused_unless_it_is_switched_off() -> None:
    for name in RANGES:
        range_ = {name: 0.04}
        more = {"latency_s": 0.05} if name == "latency_min_s" else {}
        with pytest.raises(ConfigError, match=r"randomisation\.\w+ is 0\.0\d, but randomisation\.enabled is not set"):
            RandomisationConfig(**range_, **more)
        off = RandomisationConfig(enabled=False, **range_, **more)
        assert off == RandomisationConfig(), "what is recorded is what was in force"
        assert off.enabled is False


def test_a_range_on_top_of_a_shipped_configuration_is_used_or_refused() -> None:
    asked = set()
    for path in sorted((Path(__file__).resolve().parents[2] / "configs" / "record").glob("*.yaml")):
        options = [f"--config_path={path}", "--task.randomisation.light=0.123"]
        task = parse(RecordConfig, options[:1]).task
        if "randomisation" not in vars(task):
            continue
        if task.randomisation.enabled:
            assert parse(RecordConfig, options).task.randomisation.light == 0.123
        else:
            with pytest.raises(ConfigError, match=r"randomisation\.light is 0\.123"):
                parse(RecordConfig, options)
        asked.add(path.stem)
    assert {"ur5_pick", "ur5_reach", "ur5_look"} <= asked
