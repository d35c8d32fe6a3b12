"""One environment: Gymnasium's and Stable-Baselines3's own checks, what it reports, and what it refuses."""

import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from bhd_lerobot.envs.episodes import ClosedError, ResetNeededError
from bhd_lerobot.envs.gym_env import BhdEnv
from bhd_lerobot.envs.register import ENVIRONMENTS, register
from bhd_lerobot.errors import ActionError, ConfigError
from tests.cases import each_case
from tests.envs.support import NAMES, assert_same, short

AVOID = "TurtleBot3Avoid-v0"


def make(**arguments: Any) -> BhdEnv:
    return BhdEnv(AVOID, **short(AVOID, **arguments))


@pytest.mark.parametrize(
    ("name", "normalise"), [*((name, False) for name in NAMES), (AVOID, True), ("UR5Reach-v0", True)]
)
def test_it_passes_the_checks_of_gymnasium_and_stable_baselines3(name: str, normalise: bool) -> None:
    spec = pickle.loads(pickle.dumps(gymnasium.spec(f"bhd_lerobot/{name}")))
    env = gymnasium.make(spec, normalise_actions=normalise, **short(name))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they would rather have bounded and normalised spaces
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env, skip_render_check=True)
    env.close()


def test_registering_twice_changes_nothing() -> None:
    before = dict(gymnasium.registry)
    register()
    assert dict(gymnasium.registry) == before
    assert {f"bhd_lerobot/{name}" for name in ENVIRONMENTS} <= before.keys()


def test_normalised_actions_span_the_bounds() -> None:
    plain, normalised = make(), make(normalise_actions=True)
    for corner in ([1, -1], [-1, 1], [0, 0], [0.5, 0.25]):
        plain.reset(seed=1)
        normalised.reset(seed=1)
        action = np.array(corner, np.float32)
        assert_same(normalised.step(action), plain.step(action * plain.action_space.high))


def test_observations_hold_the_requested_parts() -> None:
    assert set(BhdEnv("UR5Reach-v0").observation_space) == {"agent_pos", "environment_state"}
    pixels = BhdEnv("UR5Reach-v0", {"camera_width": 64, "camera_height": 48}, obs_type="pixels_agent_pos")
    assert set(pixels.observation_space) == {"agent_pos", "pixels"}
    assert pixels.observation_space["pixels"]["wrist"].shape == (48, 64, 3)
    observation, _ = pixels.reset(seed=0)
    assert pixels.observation_space.contains(observation)
    assert observation["pixels"]["scene"].std() > 0
    pixels.close()


def test_it_renders_in_its_render_mode() -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    assert image.shape == (240, 320, 3)
    assert image.std() > 0
    env.close()
    assert make().render() is None


@each_case(
    ("arguments", "message"),
    [
        ({"environment": "TurtleBot3Avoyd-v0"}, "Did you mean 'TurtleBot3Avoid-v0'"),
        ({"robot": {"beems": 36}}, "robot.beems"),
        ({"robot": {"beams": "many"}}, "robot.beams is 'many'; it must be a whole number"),
        ({"robot": {"clock": "realtime"}}, "robot.clock is 'realtime'"),
        ({"robot": {"type": "ur5"}}, "robot.type is 'ur5'"),
        ({"robot": 5}, "robot is 5"),
        ({"task": {"durations_s": 1.0}}, "Did you mean 'task.duration_s'"),
        ({"seed": -1}, "seed is -1"),
        ({"split": "test"}, "split is 'test'"),
        ({"obs_type": "images"}, "Unknown obs_type 'images'"),
        ({"obs_type": "pixels", "cameras": False}, "cameras is False"),
        ({"render_mode": "human"}, "Unknown render_mode 'human'"),
        ({"episode_stride": 0}, "episode_stride is 0"),
        ({"first_episode": -1}, "first_episode is -1"),
    ],
)
def test_what_cannot_be_honoured_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        BhdEnv(**{"environment": AVOID, **arguments})
    assert message in str(caught.value)


@each_case(
    ("action", "message"),
    [
        ([0.1, np.nan], "'theta.vel' of environment 0 is nan"),
        ([np.inf, 0.0], "'x.vel' of environment 0 is inf"),
        ([1e39, 0.0], "'x.vel' of environment 0 is 1e+39; actions must be finite numbers in single precision"),
        ([0.1], "shape (1, 1)"),
        (0.1, "shape (1,)"),
        (["fast", "left"], "needs (1, 2) numbers: x.vel, theta.vel"),
    ],
)
def test_a_wrong_action_is_refused_and_does_nothing(action: Any, message: str) -> None:
    env, other = make(), make()
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ActionError) as caught:
        env.step(action)
    assert message in str(caught.value)
    good = np.array([0.1, 0.2], np.float32)
    assert_same(env.step(good), other.step(good))


def test_it_must_be_reset_before_and_after_an_episode_and_not_be_closed() -> None:
    env = make(task={"duration_s": 0.1})
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(np.zeros(2, np.float32))
    env.reset()
    env.step(np.zeros(2, np.float32))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.step(np.zeros(2, np.float32))):
        with pytest.raises(ClosedError, match="was closed"):
            use()
