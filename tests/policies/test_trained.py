"""The four trained policy types: what is the same law for all of them; `learned/test_stock_commands.py` runs them."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.cnn.processor_cnn import OBS_ODOMETRY
from bhd_lerobot.policies.learned.policy import load_policy
from bhd_lerobot.policies.mlp.configuration_mlp import ScanConfig
from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig
from tests.cases import each_case
from tests.policies.cnn import test_cnn as cnn
from tests.policies.mlp import test_mlp as mlp
from tests.policies.perception import rig as perception
from tests.policies.perception.rig import save
from tests.policies.pixels import test_pixels as pixels

IMAGE, SCENE = cnn.IMAGE, perception.IMAGE
CONFIGS = {"bhd_mlp": mlp.config, "bhd_cnn": cnn.config, "bhd_pixels": pixels.made, "bhd_perception": perception.config}


def make(kind: str, **options: Any) -> Any:
    return get_policy_class(kind)(CONFIGS[kind](**options))


MLP_OPTIONS = {"gaussian": True, "n_obs_steps": 2, "scan": ScanConfig(transform="log", channels=[3])}


@each_case(
    ("kind", "options"),
    [
        *(("bhd_mlp", {**MLP_OPTIONS, "activation": one}) for one in ("relu", "tanh", "gelu", "silu", "elu")),
        *((kind, {}) for kind in CONFIGS),
    ],
)
def test_it_is_saved_and_loaded_as_a_lerobot_policy(kind: str, options: dict[str, Any], tmp_path: Path) -> None:
    policy = make(kind, **options)
    save(tmp_path, policy)
    assert policy.name == kind == PreTrainedConfig.from_pretrained(tmp_path).type
    assert PreTrainedConfig.from_pretrained(tmp_path) == policy.config
    again = type(policy).from_pretrained(tmp_path, strict=True)
    kept = policy.state_dict()
    assert again.state_dict().keys() == kept.keys()
    for name, values in again.state_dict().items():
        assert torch.allclose(values, kept[name], rtol=0, atol=0, equal_nan=True), name
    before, after = make_pre_post_processors(again.config, pretrained_path=str(tmp_path))
    for made, wanted in zip((before, after), make_pre_post_processors(policy.config, dataset_stats={}), strict=True):
        assert [type(step) for step in made.steps] == [type(step) for step in wanted.steps]
        assert [step.get_config() for step in made.steps] == [step.get_config() for step in wanted.steps]
    if kind != "bhd_perception":
        assert load_policy(tmp_path).kind == kind


@each_case("kind", CONFIGS)
def test_biases_and_deviations_do_not_decay(kind: str) -> None:
    policy = make(kind, **(MLP_OPTIONS if kind == "bhd_mlp" else {}))
    weights, others = policy.get_optim_params()
    assert others["weight_decay"] == 0
    learned = {id(one) for one in policy.parameters() if one.requires_grad}
    assert {id(one) for one in (*weights["params"], *others["params"])} == learned
    assert all(one.ndim > 1 for one in weights["params"])
    assert kind != "bhd_mlp" or any(one is policy.log_std for one in others["params"])
    assert policy.config.get_optimizer_preset().lr == policy.config.optimizer_lr
    assert policy.config.get_scheduler_preset().num_warmup_steps == policy.config.scheduler_warmup_steps


@each_case(
    ("kind", "options", "observations", "actions"),
    [
        ("bhd_mlp", {}, None, [0, 1, 2, 3]),
        ("bhd_mlp", {"n_obs_steps": 3}, [-2, -1, 0], [0, 1, 2, 3]),
        ("bhd_mlp", {"n_obs_steps": 3, "obs_stride": 4, "chunk_size": 1}, [-8, -4, 0], [0]),
        ("bhd_cnn", {}, [-4, -2, 0], [0]),
        ("bhd_pixels", {}, [-100_000, 0], [0, 1, 2, 3]),
        ("bhd_perception", {}, None, None),
    ],
)
def test_which_frames_it_needs(kind: str, options: Any, observations: Any, actions: Any) -> None:
    made = CONFIGS[kind](**options)
    assert made.observation_delta_indices == observations
    assert made.action_delta_indices == actions
    assert made.reward_delta_indices is None


@each_case(
    ("kind", "options"),
    [
        ("bhd_mlp", {}),
        ("bhd_mlp", {"n_obs_steps": 3, "obs_stride": 2, "n_action_steps": 3}),
        *(("bhd_cnn", {"n_obs_steps": steps, "chunk_size": 2}) for steps in (1, 3)),
    ],
)
def test_frame_by_frame_it_acts_as_on_the_rows_of_a_dataset(kind: str, options: dict[str, Any]) -> None:
    policy = make(kind, **options)
    config = policy.config
    shapes = {key: feature.shape for key, feature in config.input_features.items()}
    frames = [{key: torch.rand(2, *shape) for key, shape in shapes.items()} for _ in range(9)]
    before, _ = make_pre_post_processors(config, dataset_stats={})
    for _ in range(2):  # the second time as if there had been none
        policy.reset()
        chosen = torch.stack([policy.select_action(before(dict(frame))) for frame in frames])
        for number in range(9):
            start = number - number % config.n_action_steps
            rows = [max(0, start + delta) for delta in config.observation_delta_indices or [0]]
            window = {key: torch.stack([frames[row][key] for row in rows], dim=1) for key in shapes}
            wanted = policy.predict_action_chunk(before(window))[:, number - start]
            assert torch.allclose(chosen[number], wanted, atol=1e-6)


@each_case(
    ("kind", "options", "message"),
    [
        ("bhd_mlp", {"n_action_steps": 5}, "policy.n_action_steps is 5, but only policy.chunk_size = 4"),
        ("bhd_mlp", {"loss": "nll"}, "--policy.gaussian=true"),
        ("bhd_mlp", {"scan": {"kernel_size": 4}}, "policy.scan.kernel_size is 4"),
        ("bhd_mlp", {"scan": {"beams": 4}}, "give both or neither"),
        ("bhd_mlp", {"ignore": ["*.vle"]}, "'*.vle' matches no number of observation.state: x.vel, scan_000"),
        ("bhd_mlp", {"ignored_columns": [3, 10]}, "has the columns 0 to 9"),
        ("bhd_mlp", {"environment": 0, "ignore": ["*"]}, "leaves no input"),
        ("bhd_mlp", {"yaw_harmonics": 2}, "no quaternion"),
        ("bhd_mlp", {"yaw_harmonics": 2, "environment_quaternions": [0]}, "do not fit into the 3"),
        ("bhd_mlp", {"sort_objects": True}, "object_0_present"),
        ("bhd_mlp", {"relative_target": True}, "has no target_x, target_y"),
        ("bhd_mlp", {"residual": ["a.pos"], "residual_columns": [1]}, "residual_columns"),
        ("bhd_mlp", {"scan": {"transform": "log", "start": 4, "beams": 8}}, "10 columns"),
        ("bhd_cnn", {"range_minimum": 4.0}, "policy.range_minimum is 4.0"),
        ("bhd_cnn", {"camera": "rear"}, "no 'observation.images.rear'. It has observation.images.front. Record"),
        ("bhd_cnn", {"shape": (3, 8, 24)}, "are 24 x 8 px; bhd_cnn needs at least 16"),
        ("bhd_cnn", {"names": cnn.NAMES[:-3]}, "no 'x.pos'. Record it with --robot.odometry=true"),
        ("bhd_cnn", {"names": ["x.vel", *cnn.NAMES[-3:]]}, "range scan"),
        ("bhd_cnn", {"scan": {"transform": "inverse"}}, "does not read a range finder"),
        ("bhd_pixels", {"ignored_columns": [14]}, "policy.ignored_columns is [14]"),
        ("bhd_pixels", {"ignored_columns": []}, "matches no number of observation.state"),
        ("bhd_pixels", {"camera": "wrist"}, "the dataset has no 'observation.images.wrist'"),
        ("bhd_perception", {"camera": "wrist"}, "policy.camera is 'wrist', and the dataset has no"),
        ("bhd_perception", {"camera_position": [0.0, 0.0]}, "policy.camera_position is [0.0, 0.0]; it must be 3"),
        (
            "bhd_perception",
            {"camera_position": [0.37, 0.02, 1.0], "camera_target": [0.37, 0.02, 0.0]},
            "must stand above the table",
        ),
        ("bhd_perception", {"area": [0.6, -0.3, 0.4, 0.3]}, "policy.area is"),
        ("bhd_perception", {"area": [5.0, 5.0, 5.1, 5.1]}, "sees nothing"),
    ],
)
def test_values_that_cannot_be_honoured_are_named(kind: str, options: dict[str, Any], message: str) -> None:
    def make_it() -> None:
        made = {"scan": ScanConfig(**options["scan"])} if "scan" in options else {}
        make(kind, **{**options, **made})

    with pytest.raises(ConfigError) as error:
        make_it()
    assert message in str(error.value)


@each_case("kind", [PerceptionConfig, PixelsConfig])
def test_a_dataset_without_true_poses_or_images_is_refused(kind: type) -> None:
    with pytest.raises(ConfigError, match=r"true poses of objects.*Record the task 'pick'"):
        kind(device="cpu").set_dataset_feature_metadata({OBS_ENV_STATE: {"names": ["target_x"]}})
    with pytest.raises(ConfigError, match=r"It has no images. Record it with --robot.camera=true"):
        kind(device="cpu").validate_features()


def shown(kind: str) -> dict[str, Tensor]:
    """Return a preprocessed batch of one row, of what a policy reads to act or to see."""
    if kind == "bhd_pixels":
        return pixels.present(pixels.batch(1))
    made = CONFIGS[kind]()
    samples = cnn.raw(1) if kind == "bhd_cnn" else {SCENE: torch.zeros(1, 3, perception.HEIGHT, perception.WIDTH)}
    return make_pre_post_processors(made, dataset_stats={})[0](samples)


@each_case(
    ("kind", "key", "value", "message"),
    [
        ("bhd_cnn", IMAGE, None, "not in the batch. Set --robot.camera=true --robot.camera_width=24"),
        ("bhd_cnn", IMAGE, torch.zeros(1, 3, 3, 16, 12), "24 x 16 px"),
        ("bhd_cnn", IMAGE, torch.zeros(1, 2, 3, 16, 24), "3 images"),
        ("bhd_cnn", OBS_ODOMETRY, None, "Run the policy's own preprocessor first"),
        ("bhd_pixels", SCENE, None, "was trained with 'observation.images.scene', which is not in the batch"),
        ("bhd_pixels", SCENE, torch.zeros(1, 3, 60, 80), "bhd_pixels was trained with images of 160 x 120 px"),
        ("bhd_pixels", "observation.state", None, "was trained with 'observation.state', which is not"),
        ("bhd_pixels", "observation.language.tokens", None, "Run the policy's own preprocessor first"),
    ],
)
def test_a_batch_that_it_cannot_read_is_refused(kind: str, key: str, value: Any, message: str) -> None:
    batch = {name: one for name, one in {**shown(kind), key: value}.items() if one is not None}
    with pytest.raises(ConfigError) as error:
        make(kind).predict_action_chunk(batch)
    assert message in str(error.value)
