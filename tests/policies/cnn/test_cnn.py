"""`bhd_cnn`: it sees ranges, keeps in mind where things are, and reads no range finder."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.cnn.modeling_cnn import CnnPolicy
from bhd_lerobot.policies.cnn.processor_cnn import OBS_RANGES

WIDTH, HEIGHT, BEAMS, IMAGES = 24, 16, 36, 3
IMAGE = "observation.images.front"
NAMES = ["x.vel", "theta.vel", *(f"scan_{i:03}.pos" for i in range(BEAMS)), "x.pos", "y.pos", "theta.pos"]
SCAN, ODOMETRY = slice(2, 2 + BEAMS), slice(2 + BEAMS, 5 + BEAMS)


def config(names: list[str] | None = None, shape: tuple[int, ...] = (3, HEIGHT, WIDTH), **options: Any) -> CnnConfig:
    made = CnnConfig(
        device="cpu",
        input_features={
            OBS_STATE: PolicyFeature(FeatureType.STATE, (len(NAMES),)),
            IMAGE: PolicyFeature(FeatureType.VISUAL, shape),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
        **{"channels": [4, 6], "image_dim": 16, "hidden_dims": [32], "n_obs_steps": IMAGES, "obs_stride": 2, **options},
    )
    made.set_dataset_feature_metadata({OBS_STATE: {"names": NAMES if names is None else names}})
    return made


def raw(rows: int = 6, images: int = IMAGES, seed: int = 0) -> dict[str, Tensor]:
    """Return what LeRobot's loader gives; every image has the brightness of the distance straight ahead."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.rand(rows, images, len(NAMES), generator=generator) * 2 + 0.3
    near = state[..., SCAN.start] / 3.5
    return {
        OBS_STATE: state,
        IMAGE: near[..., None, None, None].expand(rows, images, 3, HEIGHT, WIDTH).clone(),
        ACTION: torch.randn(rows, 1, 2, generator=generator),
    }


def batch(made: CnnConfig, samples: dict[str, Tensor]) -> dict[str, Tensor]:
    return make_pre_post_processors(made)[0]({key: values.clone() for key, values in samples.items()})


def test_neither_scan_nor_speed_nor_the_origin_of_odometry_changes_an_action_but_images_and_motion_do() -> None:
    made = config()
    policy, samples = CnnPolicy(made).eval(), raw()
    chunk = policy.predict_action_chunk(batch(made, samples))

    def changed(key: str, columns: Any, by: Any) -> bool:
        values = samples[key].clone()
        values[..., columns] += by
        return not torch.equal(policy.predict_action_chunk(batch(made, {**samples, key: values})), chunk)

    assert not changed(OBS_STATE, SCAN, torch.rand(6, IMAGES, BEAMS))
    assert not changed(OBS_STATE, slice(0, 2), torch.rand(6, IMAGES, 2))
    moved = samples[OBS_STATE].clone()
    moved[..., ODOMETRY] += torch.tensor([1.0, -2.0, 0.0])
    again = policy.predict_action_chunk(batch(made, {**samples, OBS_STATE: moved}))
    assert torch.allclose(again, chunk, atol=1e-4)
    assert changed(OBS_STATE, ODOMETRY, torch.rand(6, IMAGES, 3))
    assert changed(IMAGE, slice(None), 0.1)
    without = {key: values for key, values in batch(made, samples).items() if key != OBS_RANGES}
    assert torch.equal(policy.predict_action_chunk(without), chunk)


@pytest.mark.parametrize("option", [{"yaw_harmonics": 2}, {"sort_objects": True}, {"relative_target": True}])
def test_options_of_a_perceptron_that_it_does_not_honour_are_refused(option: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"policy.{next(iter(option))} is .* does not do that"):
        config(**option)


def test_directions_are_those_of_the_beams_that_the_camera_shows() -> None:
    made = config(field_of_view=60.0)
    assert np.degrees(made.range_angles) == pytest.approx([-30, -20, -10, 0, 10, 20, 30])
    assert [NAMES[column] for column in made.range_columns] == [f"scan_{i:03}.pos" for i in (33, 34, 35, 0, 1, 2, 3)]
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    assert (made.range_minimum, made.range_maximum) == (lidar.range_min, lidar.range_max)
    assert made.scanner_ahead == lidar.ahead


@pytest.mark.law
def test_things_stay_where_they_are_while_the_robot_moves() -> None:
    """A point that is seen from any pose is in the same sector and distance as one that is seen from the last."""
    policy = CnnPolicy(config(scanner_ahead=-0.03, sectors=12, n_obs_steps=2)).eval()
    angles, rng = policy.config.range_angles, np.random.default_rng(0)
    for _ in range(20):
        poses = rng.uniform([-2, -2, -9], [2, 2, 9], (2, 3))
        seen = rng.uniform(0.3, 3.0, (2, len(angles)))
        found = policy.surroundings(*(torch.tensor(one)[None].float() for one in (seen, poses)))[0]
        wanted = np.zeros(12)
        x0, y0, yaw0 = poses[-1]
        for (x, y, yaw), ranges in zip(poses, seen, strict=True):
            for angle, length in zip(angles, ranges, strict=True):
                along = yaw + angle
                px = x - 0.03 * math.cos(yaw) + length * math.cos(along) - x0
                py = y - 0.03 * math.sin(yaw) + length * math.sin(along) - y0
                bearing = (math.atan2(py, px) - yaw0 + math.pi) % (2 * math.pi)
                sector = int(bearing / (2 * math.pi) * 12)
                wanted[sector] = max(wanted[sector], 0.3 / max(math.hypot(px, py), 0.1))
        assert found.numpy() == pytest.approx(wanted, abs=2e-3)


def test_it_learns_what_the_image_shows() -> None:
    made = config(n_obs_steps=2, optimizer_lr=3e-3)
    samples = raw(64, images=2)
    samples[OBS_STATE][..., SCAN] = samples[OBS_STATE][..., SCAN.start, None]
    samples[ACTION] = samples[OBS_STATE][:, -1, None, [SCAN.start, SCAN.start]] - 1.3
    policy, ready = CnnPolicy(made), batch(made, samples)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 1e-2)
    for _ in range(150):
        loss, parts = policy.forward(ready)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert set(parts) == {"l1_loss", "range_error"}
    assert parts["range_error"] < 0.1, "as a share of the range"
    assert parts["l1_loss"] < 0.1
    each, _ = policy.forward(ready, reduction="none")
    assert each.shape == (64,)
    assert torch.allclose(each.mean(), policy.forward(ready)[0])


def test_only_the_loss_of_the_ranges_depends_on_them() -> None:
    made = config(range_weight=0.0)
    policy, ready = CnnPolicy(made), batch(made, raw())
    other = {**ready, OBS_RANGES: ready[OBS_RANGES] + 1}
    assert torch.equal(policy.forward(ready)[0], policy.forward(other)[0])
    policy.config.range_weight = 0.5
    assert policy.forward(ready)[0] != policy.forward(other)[0]
