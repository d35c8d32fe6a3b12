"""Options of tasks and brains: what cannot be honoured is refused by name, and recorded parameters give them back."""

import json
from typing import Any

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import decode
from bhd_lerobot.policies.baselines import RandomConfig
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrainConfig
from bhd_lerobot.policies.navigation.avoidance import AvoidanceConfig
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerConfig
from bhd_lerobot.policies.navigation.navigator import NavigatorConfig
from bhd_lerobot.registry import make_brain, make_task
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.navigate import NavigateConfig
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.task import TaskConfig
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case


@each_case(
    ("kind", "option"),
    [
        (NavigateConfig, {"tolerance_m": 2.0}),  # more than the distance to the goal
        (NavigateConfig, {"hold_s": 60.0}),  # the whole episode
        (GapFollowerConfig, {"rim_speed": 0.2, "forward_speed": 0.3}),  # faster than the wheels
        (NavigatorConfig, {"range_max_m": 3.5, "range_min_m": 4.0}),
        (RandomisationConfig, {"latency_s": 0.01, "latency_min_s": 0.02}),
    ],
)
def test_options_that_do_not_go_together_are_refused_by_name(kind: Any, option: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=rf"\.{list(option)[-1]} is {list(option.values())[-1]}\b"):
        kind(**option)


def test_an_unknown_arena_is_an_error_with_the_near_miss() -> None:
    for kind in (AvoidConfig, NavigateConfig):
        with pytest.raises(ConfigError, match="Did you mean 'random'"):
            kind(arena="randon")


@each_case(
    "config",
    [
        AvoidConfig(arena="empty", duration_s=30.0),
        NavigateConfig(arena="empty", tolerance_m=0.2),
        ReachConfig(hold_s=0.5, randomisation=RandomisationConfig(enabled=True)),
        PickConfig(lift_m=0.2, language="any", randomisation=RandomisationConfig(enabled=True, mass=0.9)),
        AvoidanceConfig(safe_distance_m=0.6),
        GapFollowerConfig(memory_s=3.0),
        NavigatorConfig(margin_m=0.05),
        ReachBrainConfig(attempts=1, camera_error_m=[0.0, 0.01, 0.0]),
        PickBrainConfig(line_velocity=0.1),
        LanguageBrainConfig(instruction="pick up the red cup"),
        RandomConfig(scale=0.5),
    ],
)
def test_recorded_parameters_are_plain_values_that_give_the_configuration_back(config: Any) -> None:
    made = make_task(config, 1, 10) if isinstance(config, TaskConfig) else make_brain(config)
    parameters = json.loads(json.dumps(made.parameters()))
    assert parameters.pop("type") == made.name
    assert decode(type(config), parameters) == config
