"""LeRobot's side: its configuration, its features, and its own evaluation loop."""

from typing import Any

import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType
from lerobot.envs.factory import make_env
from lerobot.envs.utils import close_envs, env_to_policy_features

from bhd_lerobot.envs.config_env import BhdEnvConfig
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import episode_seed
from tests.cases import each_case
from tests.envs.support import NAMES, assert_same, some_actions

AVOID = "TurtleBot3Avoid-v0"
SHORT: dict[str, Any] = {"robot": {"beams": 36}, "task_options": {"duration_s": 1.0}}


@each_case("name", NAMES)
def test_the_features_are_those_of_the_datasets(name: str) -> None:
    config = BhdEnvConfig(task=name)
    with_state = {"observation.state": FeatureType.STATE, "action": FeatureType.ACTION}
    features = env_to_policy_features(config)
    assert {key: features[key].type for key in with_state} == with_state
    assert ("observation.environment_state" in features) == (name != AVOID)
    assert config.fps == (10 if name.startswith("TurtleBot3") and "Manipulation" not in name else 25)


def test_images_are_features_too() -> None:
    config = BhdEnvConfig(task="UR5Pick-v0", cameras=True, robot={"camera_width": 96, "camera_height": 64})
    features = env_to_policy_features(config)
    assert features["observation.images.scene"].type == FeatureType.VISUAL
    assert features["observation.images.wrist"].shape == (3, 64, 96)
    assert features["observation.environment_state"].shape == (80,)
    only = env_to_policy_features(BhdEnvConfig(task="UR5Pick-v0", obs_type="pixels"))
    assert set(only) == {"action", "observation.images.scene", "observation.images.wrist"}


KINDS = {"bhd": BhdVectorEnv, "sync": SyncVectorEnv, "async": AsyncVectorEnv}


@each_case("vector", KINDS)
def test_all_kinds_of_vector_environments_do_the_same(vector: str) -> None:
    envs = make_env(BhdEnvConfig(task=AVOID, vector=vector, seed=3, **SHORT), n_envs=2, use_async_envs=True)
    env = envs["bhd"][0]
    ours = BhdVectorEnv(
        2, AVOID, SHORT["robot"], SHORT["task_options"], seed=3, split="held_out", autoreset_mode="SameStep"
    )
    try:
        assert isinstance(env, KINDS[vector])
        assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        theirs = env.reset(seed=[0, 4])
        assert theirs[1]["seed"].tolist() == [episode_seed(3, 0, "held_out"), episode_seed(3, 4, "held_out")]
        assert_same(theirs, ours.reset(seed=[0, 4]))
        for action in some_actions(AVOID, 25, 2):
            assert_same(env.step(action), ours.step(action))
        assert tuple(env.call("_max_episode_steps")) == (10, 10)
    finally:
        close_envs(envs)


@each_case(
    ("arguments", "message"),
    [
        ({"task": None}, "Unknown environment ''"),
        ({"fps": 7}, "fps is 7"),
        ({"fps": 5, "robot": {"fps": 10}}, "env.fps is 5 and env.robot.fps is 10"),
        ({"task_options": {"legs": 2}}, "task.legs"),
    ],
)
def test_what_cannot_be_honoured_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        BhdEnvConfig(**{"task": AVOID, **arguments})
    assert message in str(caught.value)


def test_another_rate_is_the_robots_and_no_environments_are_refused() -> None:
    config = BhdEnvConfig(task=AVOID, fps=5, **SHORT)
    with pytest.raises(ConfigError, match=r"batch_size.* is 0"):
        config.create_envs(0)
    env = config.create_envs(1)["bhd"][0]
    assert env.metadata["render_fps"] == 5
    assert env.call("_max_episode_steps") == (5,)
    env.close()
