"""Tables as the pick task tells of them, and images on which each object is a spot of its colour."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from bhd_lerobot.bodies.tabletop import SCENE_CAMERA, CameraView
from bhd_lerobot.policies.manipulation.grasp import read_objects
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.configuration_perception import LABELS, PerceptionConfig
from bhd_lerobot.tasks.pick import PickConfig, PickTask

WIDTH, HEIGHT = 160, 120
IMAGE = "observation.images.scene"
FEATURES = {OBS_ENV_STATE: {"names": list(LABELS)}}
SMALL = {
    "channels": 8,
    "hidden": 12,
    "context": 8,
    "device": "cpu",
    "brightness": 0.0,
    "recolour": 0.0,
    "tint": 0.0,
    "zoom": 0.0,
}


def config(kind: type[PerceptionConfig] = PerceptionConfig, **options: Any) -> Any:
    made = kind(
        input_features={
            IMAGE: PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH)),
            OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (len(LABELS),)),
            "observation.state": PolicyFeature(FeatureType.STATE, (14,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        **{**SMALL, **options},
    )
    made.set_dataset_feature_metadata(FEATURES)
    return made


def states(count: int, **options: Any) -> np.ndarray:
    """Return what the pick task tells of different tables, shape (count, 80)."""
    task = PickTask(PickConfig(**options), count, 25)
    scenes = [task.sample(seed) for seed in range(count)]
    task.begin(np.arange(count), scenes)
    poses = np.zeros((count, 5, 7))
    for row, scene in enumerate(scenes):
        for place, one in enumerate(scene.objects):
            turn = one.yaw / 2
            poses[row, place] = one.x, one.y, one.height / 2, math.cos(turn), 0.0, 0.0, math.sin(turn)
    truth: Any = SimpleNamespace(object_poses=poses)
    return task.environment_state(truth)


def painted(values: np.ndarray, view: CameraView = SCENE_CAMERA) -> Tensor:
    """Return images with a spot of the object's colour where it is, shape (count, 3, height, width)."""
    projection = Projection(view, WIDTH, HEIGHT)
    images = np.full((len(values), HEIGHT, WIDTH, 3), 0.6, np.float32)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    for image, table in zip(images, values, strict=True):
        for one in read_objects(table.reshape(-1, 16)):
            u, v = projection.pixels(np.array(one.position))
            spot = np.hypot(column + 0.5 - u, row + 0.5 - v) < (5.0 if one.kind == "box" else 3.5)
            image[spot] = one.colour
    return torch.from_numpy(images.transpose(0, 3, 1, 2).copy())


def save(folder: Path, policy: Any) -> Path:
    """Save a policy with its processors, as a training does; return the folder."""
    policy.save_pretrained(folder)
    features = {**policy.config.input_features, **policy.config.output_features}
    stats = {key: {"mean": np.zeros(one.shape[-1]), "std": np.ones(one.shape[-1])} for key, one in features.items()}
    for one in make_pre_post_processors(policy.config, dataset_stats=stats):
        one.save_pretrained(folder)
    return folder
