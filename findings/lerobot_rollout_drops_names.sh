#!/usr/bin/env bash
# LeRobot 0.6.1 (torch 2.11.0, Python 3.12): lerobot-rollout passes over every float of a robot whose name ends in neither
# ".pos" nor ".vel", in observations and in actions, without a message. lerobot-record keeps all of them. So a policy that
# learns from what was recorded meets a state of another width on the same robot, and a gripper that is commanded by such a
# name never moves. LeRobot's own Unitree G1 has names that end in ".q".
#
# Output seen on 2026-11-28:
#   recorded: state rail.pos gripper.value, action rail.pos gripper.value
#   rollout:  state rail.pos, action rail.pos
#
#   PYTHON=/path/to/python3.12 findings/lerobot_rollout_drops_names.sh
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
export HF_HUB_OFFLINE=1 HF_HOME="$folder/hub" HF_LEROBOT_HOME="$folder/lerobot"
"${PYTHON:-python3}" -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    'lerobot[dataset,viz,deepdiff-dep,pyserial-dep]==0.6.1' 'torch==2.11.0'

cat >devices.py <<'PYTHON'
"""A gripper on a rail, and its leader: two numbers, of which one ends in neither .pos nor .vel."""

from dataclasses import dataclass

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

FEATURES = {"rail.pos": float, "gripper.value": float}


@RobotConfig.register_subclass("rail")
@dataclass
class RailConfig(RobotConfig):
    pass


@TeleoperatorConfig.register_subclass("rail_leader")
@dataclass
class RailLeaderConfig(TeleoperatorConfig):
    pass


class Device:
    is_calibrated = True
    cameras = {}
    is_connected = False

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def calibrate(self):
        pass

    def configure(self):
        pass


class Rail(Device, Robot):
    config_class, name = RailConfig, "rail"
    observation_features = action_features = FEATURES

    def get_observation(self):
        return {"rail.pos": 0.1, "gripper.value": 0.2}

    def send_action(self, action):
        return action


class RailLeader(Device, Teleoperator):
    config_class, name = RailLeaderConfig, "rail_leader"
    action_features, feedback_features = FEATURES, {}

    def get_action(self):
        return {"rail.pos": 0.3, "gripper.value": 0.4}

    def send_feedback(self, feedback):
        pass
PYTHON

cat >show.py <<'PYTHON'
import json
import logging
import sys
import threading
from pathlib import Path

import torch
from devices import RailConfig
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.rollout.configs import RolloutConfig
from lerobot.rollout.context import build_rollout_context
from lerobot.scripts import lerobot_record

logging.disable(logging.CRITICAL)


def shown(features):
    return f"state {' '.join(features['observation.state']['names'])}, action {' '.join(features['action']['names'])}"


sys.argv = [
    "lerobot-record", "--robot.type=rail", "--robot.id=a", "--teleop.type=rail_leader", "--teleop.id=b",
    "--dataset.repo_id=u/rail", "--dataset.root=set", "--dataset.single_task=move", "--dataset.num_episodes=1",
    "--dataset.episode_time_s=0.5", "--dataset.push_to_hub=false", "--play_sounds=false",
]
lerobot_record.main()
recorded = shown(json.loads(Path("set/meta/info.json").read_text())["features"])

widths = {"observation.state": 2, "observation.environment_state": 1, "action": 2}
kinds = dict(zip(widths, (FeatureType.STATE, FeatureType.ENV, FeatureType.ACTION)))
features = {key: PolicyFeature(kinds[key], (width,)) for key, width in widths.items()}
config = ACTConfig(
    device="cpu", pretrained_backbone_weights=None, dim_model=16, n_heads=2, dim_feedforward=16, n_encoder_layers=1,
    n_vae_encoder_layers=1, latent_dim=4, chunk_size=2, n_action_steps=1,
    input_features={key: one for key, one in features.items() if key != "action"},
    output_features={"action": features["action"]},
)
get_policy_class("act")(config).save_pretrained("policy")
statistics = {key: {"mean": torch.zeros(width), "std": torch.ones(width)} for key, width in widths.items()}
for processor in make_pre_post_processors(config, dataset_stats=statistics):
    processor.save_pretrained("policy")
policy = PreTrainedConfig.from_pretrained("policy")
policy.pretrained_path = Path("policy")
sys.argv = ["lerobot-rollout"]
settings = RolloutConfig(robot=RailConfig(id="a"), policy=policy, device="cpu", task="move")
rollout = shown(build_rollout_context(settings, threading.Event()).data.dataset_features)

print(f"recorded: {recorded}\nrollout:  {rollout}")
expected = ("state rail.pos gripper.value, action rail.pos gripper.value", "state rail.pos, action rail.pos")
sys.exit(0 if (recorded, rollout) == expected else "This has changed.")
PYTHON

venv/bin/python show.py 2>messages || { cat messages >&2; exit 1; }
