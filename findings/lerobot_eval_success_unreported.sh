#!/bin/sh
# LeRobot's evaluation counts an episode as a success when its environment says nothing about success.
#
# Versions: lerobot 0.6.1, gymnasium 1.4.0, torch 2.11.0; Python 3.12, Linux, x86-64.
#
# A Gymnasium environment gives no reward, never terminates, and is truncated by its limit of 5 steps. Its info has no
# "is_success". LeRobot's EnvConfig makes a vector environment of it that resets in the same step, and eval_policy, which
# lerobot-eval calls, reports a success rate of 100 %. The default of rollout for a missing "is_success" is a list with one
# False per environment, and the truth value of that list is used. With {"is_success": False} in the info, or with
# Gymnasium's own default, a reset in the next step, the same episodes have a success rate of 0 %.
#
# LeRobot's guide for new benchmarks asks for "is_success" in every info. Its guide for environments from the Hub does not,
# and shows CartPole, which has none. Nothing checks it, and no warning names it.
#
# Expected: 0 % in all three cases, as the default says, or an error.
#
# Output seen:
#   lerobot 0.6.1, gymnasium 1.4.0: success rate of 4 episodes that reach their limit of 5 steps
#   is_success False, reset in the same step: 0 %
#   no is_success, reset in the same step: 100 %
#   no is_success, reset in the next step: 0 %
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    "lerobot[dataset]==0.6.1" gymnasium==1.4.0 torch==2.11.0
export HF_HUB_OFFLINE=1 HF_HOME="$folder/home" HF_LEROBOT_HOME="$folder/home/lerobot"
"$folder/venv/bin/python" - <<'PY' 2>"$folder/messages" || { cat "$folder/messages" >&2; exit 1; }
import sys
from dataclasses import dataclass
from importlib.metadata import version

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig, make_env, make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.scripts.lerobot_eval import eval_policy


class Wait(gymnasium.Env):
    box = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict({"agent_pos": box, "environment_state": box})
    action_space = box
    task = task_description = "wait"

    def __init__(self, info):
        self.info = info

    def observation(self):
        return {name: np.zeros(2, np.float32) for name in self.observation_space}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation(), dict(self.info)

    def step(self, action):
        return self.observation(), 0.0, False, False, dict(self.info)


gymnasium.register("gym_wait/Wait-v0", Wait, max_episode_steps=5)


@EnvConfig.register_subclass("wait")
@dataclass
class WaitConfig(EnvConfig):
    task: str = "Wait-v0"
    reports: bool = False

    @property
    def gym_kwargs(self):
        return {"info": {"is_success": False} if self.reports else {}}


config = ACTConfig(
    device="cpu", pretrained_backbone_weights=None, dim_model=16, n_heads=2, dim_feedforward=16, n_encoder_layers=1,
    n_vae_encoder_layers=1, latent_dim=4, chunk_size=2, n_action_steps=1,
    input_features={
        "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
    },
    output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
)
policy = ACTPolicy(config)
silent = WaitConfig()
next_step = SyncVectorEnv(
    [lambda: gymnasium.make(silent.gym_id, **silent.gym_kwargs)] * 2, autoreset_mode=AutoresetMode.NEXT_STEP
)
cases = {
    "is_success False, reset in the same step": make_env(WaitConfig(reports=True), n_envs=2)["wait"][0],
    "no is_success, reset in the same step": make_env(silent, n_envs=2)["wait"][0],
    "no is_success, reset in the next step": next_step,
}
print(f"lerobot {version('lerobot')}, gymnasium {version('gymnasium')}: ", end="")
print("success rate of 4 episodes that reach their limit of 5 steps")
rates = []
for name, env in cases.items():
    processors = *make_env_pre_post_processors(silent, config), *make_pre_post_processors(config)
    rates.append(eval_policy(env, policy, *processors, n_episodes=4, start_seed=0)["aggregated"]["pc_success"])
    env.close()
    print(f"{name}: {rates[-1]:.0f} %")
sys.exit(0 if rates == [0, 100, 0] else "This has changed.")
PY
