"""What others wrote for Gymnasium's environments works on ours: Stable-Baselines3, and Gymnasium's own wrappers."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from bhd_lerobot.envs.register import ENVIRONMENTS
from tests.cases import each_case
from tests.envs.support import short

AVOID = "bhd_lerobot/TurtleBot3Avoid-v0"
FRAMES = 5
BRIEF: dict[str, Any] = {"robot": {"beams": 8}, "task": {"duration_s": FRAMES / 10}}


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(("learner", "name"), [(SAC, "TurtleBot3Avoid-v0"), (PPO, "UR5Reach-v0")])
def test_stable_baselines3_learns(learner: Any, name: str) -> None:
    arguments = {**short(name), "normalise_actions": True}
    arguments["task"] = {**arguments["task"], "duration_s": 1.0}
    plain = make_vec_env(f"bhd_lerobot/{name}", n_envs=2, seed=0, env_kwargs=arguments)
    envs = VecNormalize(plain, norm_obs_keys=["agent_pos"])
    options: dict[str, Any] = {"n_steps": 32, "n_epochs": 1} if learner is PPO else {"learning_starts": 40}
    options |= {"buffer_size": 200} if learner is SAC else {}
    model = learner(
        "MultiInputPolicy", envs, batch_size=16, seed=0, device="cpu", policy_kwargs={"net_arch": [8]}, **options
    )
    before = [value.detach().clone() for value in model.policy.parameters()]
    model.learn(64)
    assert any((one != other).any() for one, other in zip(before, model.policy.parameters(), strict=True))
    # Its Monitor writes the return and the length of every episode that ended.
    assert len(model.ep_info_buffer) >= 2
    assert all({"r", "l", "t"} <= set(one) for one in model.ep_info_buffer)
    rewards, lengths = evaluate_policy(model, envs, n_eval_episodes=2, return_episode_rewards=True)
    assert np.isfinite(rewards).all()
    assert min(lengths) > 0
    envs.close()


def starts(envs: VecEnv, resets: int = 3) -> list[list[int]]:
    """Return the seeds of the first episodes of each environment."""
    seeds = []
    for _ in range(resets):
        envs.reset()
        seeds.append([info["seed"] for info in envs.reset_infos])
    return np.transpose(seeds).tolist()


@each_case("seed", [3, None])
def test_environments_of_stable_baselines3_run_different_episodes(seed: int | None) -> None:
    def make() -> list[list[int]]:
        envs = make_vec_env(AVOID, n_envs=4, seed=seed, env_kwargs=BRIEF)
        seeds = starts(envs)
        envs.close()
        return seeds

    seeds = make()
    assert len(set(np.ravel(seeds))) == 12
    assert (make() == seeds) == (seed is not None)


def flat(env: gymnasium.Env) -> gymnasium.Env:
    return wrappers.FlattenObservation(env)


SINGLE: dict[str, Callable[[gymnasium.Env], gymnasium.Env]] = {
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, FRAMES - 2),
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "Autoreset": wrappers.Autoreset,
    "FlattenObservation": flat,
    "FilterObservation": lambda env: wrappers.FilterObservation(env, ["agent_pos"]),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(flat(env), 2),
    "NormalizeObservation": lambda env: wrappers.NormalizeObservation(flat(env)),
    "TimeAwareObservation": lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(flat(env), FRAMES)),
    "AddRenderObservation": lambda env: wrappers.AddRenderObservation(env, render_only=True),
    "ClipAction": wrappers.ClipAction,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 3),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "NormalizeReward": wrappers.NormalizeReward,
    "RenderCollection": wrappers.RenderCollection,
}


@pytest.mark.thorough(but=3)
@pytest.mark.parametrize("name", SINGLE)
def test_wrappers_of_single_environments(name: str) -> None:
    renders = name in ("AddRenderObservation", "RenderCollection")
    env = SINGLE[name](gymnasium.make(AVOID, **BRIEF, render_mode="rgb_array" if renders else None))
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    ends = 0
    for _ in range(3 * FRAMES):
        assert env.observation_space.contains(observation)
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            ends += 1
            if name == "RecordEpisodeStatistics":
                assert info["episode"]["l"] == FRAMES
            if name != "Autoreset":
                observation, info = env.reset()
        assert {"is_success", "event", "episode_index", "seed"} <= info.keys()
    assert ends >= 2
    env.close()


VECTOR: dict[str, Callable[[Any], Any]] = {
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "DictInfoToList": vector.DictInfoToList,
    "NormalizeObservation": lambda env: vector.NormalizeObservation(vector.FlattenObservation(env)),
    "FlattenObservation": vector.FlattenObservation,
    "FilterObservation": lambda env: vector.FilterObservation(env, ["agent_pos"]),
    "RescaleAction": lambda env: vector.RescaleAction(env, np.float32(-1), np.float32(1)),
    "NormalizeReward": vector.NormalizeReward,
    "everything": lambda env: vector.DictInfoToList(vector.RecordEpisodeStatistics(env)),
}
N = 3


# Gymnasium's wrappers of observations refuse this mode, with any environment.
NEXT_STEP_ONLY = ("NormalizeObservation", "FlattenObservation", "FilterObservation")


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_wrappers_of_vector_environments(mode: AutoresetMode) -> None:
    for name, wrap in VECTOR.items():
        if mode == AutoresetMode.SAME_STEP and name in NEXT_STEP_ONLY:
            continue
        env = wrap(gymnasium.make_vec(AVOID, N, "vector_entry_point", autoreset_mode=mode, **BRIEF))
        env.action_space.seed(0)
        env.reset(seed=0)
        ended: list[int] = []
        for _ in range(3 * FRAMES):
            _, _, terminated, truncated, infos = env.step(env.action_space.sample())
            done = np.flatnonzero(np.asarray(terminated) | np.asarray(truncated))
            if name == "everything":
                assert all({"episode_index", "seed", "event"} <= info.keys() for info in infos)
                assert all(infos[i]["episode"]["l"] == FRAMES for i in done)
            ended += done.tolist()
        assert len(ended) >= 2 * N, name
        env.close()


FORGET = """
env.reset(seed=0)
env.close()
del sys.modules["bhd_lerobot.envs.register"]
for name in [name for name in gymnasium.registry if name.startswith("bhd_lerobot/")]:
    del gymnasium.registry[name]
"""


@pytest.mark.thorough
def test_every_documented_way_registers_and_makes_an_environment_where_nothing_was_imported() -> None:
    """In one interpreter that forgets the registration after each, because starting one takes seconds."""
    name = f"bhd_lerobot/{next(iter(ENVIRONMENTS))}"
    ways = [
        f"env = gymnasium.make('bhd_lerobot.envs.register:{name}')",
        f"import bhd_lerobot.envs.register; env = gymnasium.make('{name}')",
        f"env = gymnasium.make_vec('bhd_lerobot.envs.register:{name}', 2)",
    ]
    text = "import gymnasium, sys\n" + FORGET.join([*ways, ""])
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
