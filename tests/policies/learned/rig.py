"""Tiny untrained policies, saved as a training saves them, and LeRobot's own way to run them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from numpy.typing import NDArray

from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig, ScanConfig
from bhd_lerobot.policies.perception.configuration_perception import LABELS
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig

STATE = ("x.vel", "theta.vel", *(f"scan_{i:03}.pos" for i in range(12)))
ENVIRONMENT = ("goal_x", "goal_y")
ACTIONS = ("x.vel", "theta.vel")
FPS = 10
IMAGE = (32, 48, 3)  # height, width, channels

_SMALL_ACT = {
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "n_decoder_layers": 1,
    "n_vae_encoder_layers": 1,
    "latent_dim": 4,
    "chunk_size": 6,
    "pretrained_backbone_weights": None,
}
_SMALL_DIFFUSION = {
    "down_dims": (8, 16),
    "n_groups": 4,
    "diffusion_step_embed_dim": 8,
    "horizon": 8,
    "n_action_steps": 3,
    "num_train_timesteps": 4,
    "spatial_softmax_num_keypoints": 4,
    "pretrained_backbone_weights": None,
    "clip_sample": False,
}
_MLP: dict[str, Any] = {"hidden_dims": [32, 32], "chunk_size": 6, "n_action_steps": 3}
KINDS: dict[str, tuple[type, dict[str, Any]]] = {
    "mlp": (MlpConfig, _MLP),
    "mlp_history": (MlpConfig, {**_MLP, "n_obs_steps": 3, "obs_stride": 2, "layer_norm": True, "activation": "tanh"}),
    "mlp_scan": (MlpConfig, {**_MLP, "n_obs_steps": 2, "scan": {"transform": "inverse", "channels": [3, 4]}}),
    # Any four numbers are a quaternion of some length.
    "mlp_yaw": (
        MlpConfig,
        {**_MLP, "n_obs_steps": 2, "yaw_harmonics": 2, "state_quaternions": [2, 7], "ignore": ["*.vel"]},
    ),
    "mlp_sample": (MlpConfig, {**_MLP, "gaussian": True, "sample": True}),
    "act": (ACTConfig, {**_SMALL_ACT, "n_action_steps": 3}),
    "act_average": (ACTConfig, {**_SMALL_ACT, "n_action_steps": 1, "temporal_ensemble_coeff": 0.01}),
    "act_image": (ACTConfig, {**_SMALL_ACT, "n_action_steps": 3}),
    "diffusion": (DiffusionConfig, _SMALL_DIFFUSION),
    "diffusion_ddim": (DiffusionConfig, {**_SMALL_DIFFUSION, "noise_scheduler_type": "DDIM"}),
    "diffusion_image": (DiffusionConfig, _SMALL_DIFFUSION),
    # Any three numbers are odometry.
    "cnn_image": (
        CnnConfig,
        {
            **_MLP,
            **{"n_obs_steps": 3, "obs_stride": 2, "channels": [4, 6], "image_dim": 16, "ignored_columns": [0, 1]},
            **{"range_columns": [5, 2, 3], "range_angles": [-0.5, 0.0, 0.5], "odometry_columns": [6, 7, 8]},
        },
    ),
    "pixels_image": (PixelsConfig, {"hidden_dims": [32], "chunk_size": 6, "n_action_steps": 3, "camera": "front"}),
}
INSTRUCTION = "drive"


def save_policy(folder: Path, kind: str = "mlp", **overrides: Any) -> Path:
    """Save an untrained policy, its processors and its contract; return the folder."""
    config_class, options = KINDS[kind]
    options = {**options, **overrides}
    if "scan" in options:
        options["scan"] = ScanConfig(**options["scan"])
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (len(STATE),)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (len(ENVIRONMENT),)),
    }
    if kind.endswith("_image"):
        inputs["observation.images.front"] = PolicyFeature(FeatureType.VISUAL, (3, *IMAGE[:2]))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (len(ACTIONS),))}
    if kind == "pixels_image":
        del inputs["observation.environment_state"]
        outputs["observation.environment_state"] = PolicyFeature(FeatureType.ENV, (len(LABELS),))
        options["ignored_columns"] = [0, 1]
    config: Any = config_class(device="cpu", input_features=inputs, output_features=outputs, **options)
    if isinstance(config, MlpConfig) and kind != "cnn_image":
        config.set_dataset_feature_metadata({"observation.state": {"names": list(STATE)}})
    torch.manual_seed(7)
    policy = get_policy_class(config.type)(config)
    rng = np.random.default_rng(3)
    sizes = {"observation.state": len(STATE), "observation.environment_state": len(ENVIRONMENT), "action": len(ACTIONS)}
    stats: dict[str, Any] = {}
    for key, size in sizes.items():
        mean, std = rng.normal(size=size), rng.uniform(0.5, 2, size)
        stats[key] = {"mean": mean, "std": std, "min": mean - 2 * std, "max": mean + 2 * std}
    shape = (3, 1, 1)
    stats["observation.images.front"] = {"mean": np.full(shape, 0.4), "std": np.full(shape, 0.2)}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    PolicyContract(
        robot_type="turtlebot3",
        fps=FPS,
        observation_names=STATE,
        action_names=ACTIONS,
        environment_names=ENVIRONMENT,
        cameras={"front": IMAGE} if kind.endswith("_image") else {},
        units="SI",
    ).save(folder)
    return folder


class Stock:
    """The policy and its processors as LeRobot's evaluation runs them, one environment at a time."""

    def __init__(self, folder: Path) -> None:
        from lerobot.configs import PreTrainedConfig

        config = PreTrainedConfig.from_pretrained(folder)
        self.policy: Any = get_policy_class(config.type).from_pretrained(str(folder))
        self.before, self.after = make_pre_post_processors(config, pretrained_path=str(folder))

    def reset(self, seed: int) -> None:
        torch.manual_seed(seed)
        self.policy.reset()

    def act(self, seen: Observation, sim: int = 0) -> NDArray[np.float32]:
        from lerobot.envs.utils import preprocess_observation

        raw: dict[str, Any] = {
            "agent_pos": seen.state[sim : sim + 1],
            "environment_state": np.asarray(seen.environment_state)[sim : sim + 1],
        }
        if seen.images:
            raw["pixels"] = {name: image[sim : sim + 1] for name, image in seen.images.items()}
        batch = preprocess_observation(raw)
        batch["task"] = [INSTRUCTION]
        with torch.inference_mode():
            return self.after(self.policy.select_action(self.before(batch))).numpy()[0]


def observations(n: int, frames: int, seed: int = 0, running: Any = None) -> Iterator[Observation]:
    """Yield what n robots see, in single precision, as the episode loop shows it."""
    rng = np.random.default_rng(seed)
    for _ in range(frames):
        state = np.abs(rng.normal(1, 0.5, (n, len(STATE)))).astype(np.float32).astype(np.float64)
        told = rng.normal(size=(n, len(ENVIRONMENT))).astype(np.float32).astype(np.float64)
        images = {"front": rng.integers(0, 255, (n, *IMAGE), dtype=np.uint8)}
        yield Observation(STATE, state, images, told, running=running)


def make_brain(path: Path, **options: Any) -> LearnedBrain:
    """Return a brain, bound."""
    brain = LearnedBrain(LearnedBrainConfig(str(path), **options))
    brain.bind(RobotFeatures(STATE, ACTIONS, FPS, ENVIRONMENT))
    return brain
