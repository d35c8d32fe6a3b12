"""Options of tasks and brains: what cannot be honoured is refused by name, and recorded parameters give them back."""

import dataclasses
import json
import math
import re
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

# Numbers that a class refuses, besides those that are not finite.
OUT_OF_RANGE: dict[Any, dict[str, tuple[float, ...]]] = {
    AvoidConfig: {"duration_s": (0.0,), "cell_m": (-0.25,), "min_path_m": (-1.0,)},
    NavigateConfig: {
        "tolerance_m": (0.0, 2.0),  # 2 m is more than the distance to the goal
        "tolerance_deg": (-1.0, 181.0),
        "hold_s": (60.0,),  # the whole episode
        "rest_speed": (0.0,),
        "goal_clearance_m": (-0.1,),
        "stuck_time_s": (0.0,),
    },
    ReachConfig: {
        **dict.fromkeys(("duration_s", "tolerance_m", "tolerance_deg", "hold_s"), (0.0, -1.0)),
        "start_spread_rad": (-0.1, 1.1),
    },
    PickConfig: dict.fromkeys(("duration_s", "lift_m", "hold_s"), (0.0, -1.0)),
    RandomisationConfig: {
        "size": (1.0, -0.1),
        "light": (1.0,),
        **dict.fromkeys(("mass", "friction", "colour", "surface"), (-0.1,)),
        **dict.fromkeys(("light_direction", "camera_m", "camera_rad"), (-0.1,)),
        **dict.fromkeys(("sensor_noise_rad", "latency_s", "latency_min_s"), (-0.1,)),
    },
    AvoidanceConfig: {"front_sector_deg": (0.0, 181.0)},
    GapFollowerConfig: {
        "forward_speed": (0, 0.3),  # 0.3 m/s is faster than the wheels
        "settle_s": (0,),
        "turn_speed": (-1.0,),
        "horizon_m": (9.0, 0.1),
        "discount": (1.5,),
        "stop_m": (2.0,),
        "memory_s": (0,),
        "range_min_m": (4.0,),
    },
    NavigatorConfig: {"forward_speed": (0.0, 0.3), "arrive_m": (-0.1, 0), "horizon_m": (9.0,), "stop_m": (1.5,)},
    ReachBrainConfig: {"max_velocity": (0.0, 4.0), "attempts": (0,)},
    PickBrainConfig: {"max_velocity": (0.0,), "line_velocity": (-1.0,), "attempts": (0,)},
    LanguageBrainConfig: {},
    RandomConfig: {"period_s": (-1.0,), "scale": (0.0, 1.5)},
}


@pytest.mark.law
@each_case("kind", OUT_OF_RANGE)
def test_a_number_that_cannot_be_honoured_is_refused_by_name(kind: Any) -> None:
    prefix = "randomisation" if kind is RandomisationConfig else "task" if "tasks" in kind.__module__ else "brain"
    values = {name: list(numbers) for name, numbers in OUT_OF_RANGE[kind].items()}
    for field in dataclasses.fields(kind):
        if field.type in (float, "float"):
            values[field.name] = [*values.get(field.name, ()), math.nan, math.inf, -math.inf]
    assert len(values) > 1
    for name, numbers in values.items():
        for number in numbers:
            with pytest.raises(ConfigError, match=re.escape(f"{prefix}.{name} is {number}") + r"\b"):
                kind(**{name: number})


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
