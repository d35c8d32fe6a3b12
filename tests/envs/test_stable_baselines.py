"""The vector environment of stable-baselines3: the same as its own around single environments."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.envs.gym_env import BhdEnv
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError

vec_env: Any = pytest.importorskip("stable_baselines3.common.vec_env")

N = 3
OPTIONS: dict[str, Any] = {"robot": {"beams": 36}, "task": {"duration_s": 1.0}, "normalise_actions": True}


def test_it_is_what_stable_baselines3_makes_of_single_environments() -> None:
    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    ours = BhdSb3VecEnv(BhdVectorEnv(N, "TurtleBot3Avoid-v0", autoreset_mode="Disabled", **OPTIONS))
    theirs = vec_env.DummyVecEnv([lambda: BhdEnv("TurtleBot3Avoid-v0", **OPTIONS) for _ in range(N)])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    rng, ends = np.random.default_rng(0), 0
    for env in (ours, theirs):
        env.seed(5)
    first, second = ours.reset(), theirs.reset()
    for _ in range(25):
        for key, value in second.items():
            np.testing.assert_array_equal(first[key], value)
        actions = rng.uniform(-1, 1, (N, 2)).astype(np.float32)
        before = {key: value.copy() for key, value in first.items()}
        kept = first
        (first, *one), (second, *other) = ours.step(actions), theirs.step(actions)
        for key, value in before.items():
            np.testing.assert_array_equal(kept[key], value)  # what was handed out stays as it was
        for mine, its in zip(one[:2], other[:2], strict=True):
            np.testing.assert_array_equal(mine, its)
        for mine, its in zip(one[2], other[2], strict=True):
            if "terminal_observation" in its:
                ends += 1
                assert mine["TimeLimit.truncated"] == its["TimeLimit.truncated"]
                assert mine["is_success"] == its["is_success"]
                for key, value in its["terminal_observation"].items():
                    np.testing.assert_array_equal(mine["terminal_observation"][key], value)
    assert ends >= 2 * N
    for env in (ours, theirs):
        env.close()


def test_another_autoreset_mode_is_refused() -> None:
    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    env = BhdVectorEnv(1, "TurtleBot3Avoid-v0", autoreset_mode="SameStep", **OPTIONS)
    with pytest.raises(ConfigError, match=r"autoreset_mode is 'SameStep'.*autoreset_mode='Disabled'"):
        BhdSb3VecEnv(env)
    env.close()


def test_a_learner_of_stable_baselines3_learns_in_it() -> None:
    from stable_baselines3 import PPO

    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    env = BhdSb3VecEnv(BhdVectorEnv(4, "TurtleBot3Avoid-v0", autoreset_mode="Disabled", **OPTIONS))
    model = PPO("MultiInputPolicy", env, seed=0, n_steps=16, batch_size=32, n_epochs=1, device="cpu").learn(64)
    assert model.num_timesteps == 64
    assert len(model.ep_info_buffer or ()) >= 4
    env.close()
