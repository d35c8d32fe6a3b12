"""From an environment's name and some overrides to the configurations of its robot and its task."""

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bhd_lerobot.envs.register import ENVIRONMENTS, NAMESPACE
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.parse import decode
from bhd_lerobot.registry import check_task, robot_configs
from bhd_lerobot.tasks.task import TaskConfig

OBS_TYPES: dict[str, tuple[str, ...]] = {
    "state": ("agent_pos", "environment_state"),
    "environment_state_agent_pos": ("agent_pos", "environment_state"),
    "pixels": ("pixels",),
    "pixels_agent_pos": ("pixels", "agent_pos"),
    "pixels_environment_state_agent_pos": ("pixels", "agent_pos", "environment_state"),
}
"""What an observation holds, as far as the task and the robot have it, by LeRobot's names of observation types."""


@dataclass(frozen=True)
class Settings:
    """What an environment is made of; `parts` are some of `agent_pos`, `environment_state` and `pixels`."""

    name: str
    robot: Any
    task: Any
    parts: tuple[str, ...]


def make_settings(
    environment: str,
    robot: Any = None,
    task: Any = None,
    *,
    cameras: bool | None = None,
    obs_type: str | None = None,
) -> Settings:
    """Return what an environment is made of."""
    name = environment.removeprefix(f"{NAMESPACE}/") if isinstance(environment, str) else environment
    if name not in ENVIRONMENTS:
        raise ConfigError(unknown_name("environment", environment, ENVIRONMENTS))
    robot_type, task_type = ENVIRONMENTS[name]
    made_robot = _configuration(robot_configs()[robot_type], robot, "robot", robot_type)
    made_task = _configuration(TaskConfig.get_choice_class(task_type), task, "task", task_type)
    check_task(made_task, made_robot)
    if made_robot.clock != "lockstep":
        raise ConfigError(
            f"robot.clock is {made_robot.clock!r}; an environment's time goes by when it is stepped: leave it "
            "'lockstep'. On the wall clock, bhd-eval and lerobot-rollout evaluate policies."
        )
    wants_pixels = obs_type in OBS_TYPES and "pixels" in OBS_TYPES[str(obs_type)]
    if cameras is None:
        cameras = made_robot.camera or wants_pixels
    if obs_type is None:
        obs_type = "pixels_environment_state_agent_pos" if cameras else "state"
    if obs_type not in OBS_TYPES:
        raise ConfigError(unknown_name("obs_type", obs_type, OBS_TYPES))
    if wants_pixels and not cameras:
        raise ConfigError(f"obs_type is {obs_type!r} and cameras is False; set cameras=True to observe images.")
    made_robot.camera = cameras and "pixels" in OBS_TYPES[obs_type]
    return Settings(name, made_robot, made_task, OBS_TYPES[obs_type])


def _configuration(kind: Any, given: Any, prefix: str, type_name: str) -> Any:
    if isinstance(given, kind):
        return dataclasses.replace(given)  # the caller's own stays as it is
    values = dict(given or {}) if isinstance(given, Mapping | None) else given
    if not isinstance(values, dict):
        raise ConfigError(f"{prefix} is {given!r}; it must be a {kind.__name__} or options of one, by name.")
    if values.pop("type", type_name) != type_name:
        raise ConfigError(f"{prefix}.type is {given['type']!r}; this environment's is {type_name!r}.")
    return decode(kind, copy.deepcopy(values), f"{prefix}.")
