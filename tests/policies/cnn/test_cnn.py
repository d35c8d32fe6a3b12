"""`bhd_cnn`: it sees ranges, keeps in mind where things are, and reads no range finder."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.cnn.modeling_cnn import CnnPolicy
from bhd_lerobot.policies.cnn.processor_cnn import OBS_ODOMETRY, OBS_RANGES
from bhd_lerobot.policies.learned.policy import load_policy
from tests.cases import each_case

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


# --- inputs -----------------------------------------------------------------------------------------------------------


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


def test_directions_are_those_of_the_beams_that_the_camera_shows() -> None:
    made = config(field_of_view=60.0)
    assert np.degrees(made.range_angles) == pytest.approx([-30, -20, -10, 0, 10, 20, 30])
    assert [NAMES[column] for column in made.range_columns] == [f"scan_{i:03}.pos" for i in (33, 34, 35, 0, 1, 2, 3)]
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    assert (made.range_minimum, made.range_maximum) == (lidar.range_min, lidar.range_max)
    assert made.scanner_ahead == lidar.ahead


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


# --- learning ---------------------------------------------------------------------------------------------------------


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


# --- acting -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("images", [1, IMAGES])
def test_frame_by_frame_it_does_what_it_does_with_the_history_in_one_piece(images: int, tmp_path: Path) -> None:
    made = config(n_obs_steps=images)
    policy = CnnPolicy(made)
    policy.save_pretrained(tmp_path)
    for one in make_pre_post_processors(made):
        one.save_pretrained(tmp_path)
    loaded = load_policy(tmp_path)
    assert loaded.cameras == {IMAGE: "front"}
    samples = raw(1, images=7)
    for frame in range(7):
        shown = {key: samples[key][:, frame] for key in (OBS_STATE, IMAGE)}
        action = loaded.policy.select_action(loaded.before(shown))
        frames = [max(0, frame - 2 * back) for back in reversed(range(images))]
        window = {key: samples[key][:, frames] for key in (OBS_STATE, IMAGE)}
        wanted = policy.predict_action_chunk(batch(made, window))[:, 0]
        assert torch.allclose(action, wanted, atol=1e-6)
    assert get_policy_class("bhd_cnn") is CnnPolicy


# --- refusals ---------------------------------------------------------------------------------------------------------


@each_case(
    ("options", "message"),
    [
        ({"sectors": 0}, r"policy\.sectors is 0"),
        ({"channels": []}, r"policy\.channels is \[\]"),
        ({"field_of_view": 0}, r"policy\.field_of_view is 0"),
        ({"range_minimum": 4.0}, r"policy\.range_minimum is 4\.0"),
        ({"range_weight": -1}, r"policy\.range_weight is -1"),
        ({"camera": "rear"}, r"observation\.images\.rear.*observation\.images\.front.*robot\.camera=true"),
        ({"shape": (3, 8, 24)}, r"24 x 8 px.*at least 16"),
        ({"names": NAMES[:-3]}, r"no 'x\.pos'.*robot\.odometry=true"),
        ({"names": ["x.vel", *NAMES[-3:]]}, r"range scan"),
    ],
)
def test_it_refuses(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CnnPolicy(config(**options))


def test_it_refuses_to_read_a_scan() -> None:
    with pytest.raises(ConfigError, match=r"does not read a range finder"):
        config(scan=type(config().scan)(transform="inverse"))


@each_case(
    ("break_it", "message"),
    [
        (lambda ready: ready.pop(IMAGE), r"not in the batch.*camera_width=24 --robot\.camera_height=16"),
        (lambda ready: ready.update({IMAGE: ready[IMAGE][..., :12]}), r"24 x 16 px.*\(3, 3, 16, 12\)"),
        (lambda ready: ready.update({IMAGE: ready[IMAGE][:, :2]}), r"3 images"),
        (lambda ready: ready.pop(OBS_ODOMETRY), r"bhd_odometry.*preprocessor"),
    ],
)
def test_it_refuses_a_batch(break_it: Any, message: str) -> None:
    made = config()
    ready = batch(made, raw())
    break_it(ready)
    with pytest.raises(ConfigError, match=message):
        CnnPolicy(made).predict_action_chunk(ready)


def test_it_knows_the_statistics_as_a_perceptron_does() -> None:
    stats = {
        OBS_STATE: {"mean": torch.zeros(len(NAMES)), "std": torch.full((len(NAMES),), 2.0)},
        ACTION: {"mean": torch.zeros(2), "std": torch.ones(2)},
    }
    policy = CnnPolicy(config(residual=["*.vel"], residual_columns=[0, 1]), dataset_stats=stats)
    assert policy.residual is not None
    state = torch.randn(5, len(NAMES))
    assert torch.equal(policy.residual(state)[:, 0], 2 * state[:, :2])
