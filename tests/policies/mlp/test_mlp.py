"""`bhd_mlp`: its inputs, its losses, weights in and out, and what it refuses."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig, ScanConfig
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from bhd_lerobot.policies.mlp.objects_mlp import (
    OBS_RELATIVE,
    ObjectOrderProcessorStep,
    object_columns,
    relative_features,
    relative_size,
)
from bhd_lerobot.policies.mlp.scan_mlp import OBS_SCAN, ScanEncoder
from bhd_lerobot.policies.mlp.target_mlp import OBS_TARGET, TARGET_SIZE, target_features
from bhd_lerobot.policies.trained import TARGET, TOOL, residual_columns
from bhd_lerobot.tasks.pick import ENVIRONMENT
from tests.cases import each_case

NAMES = ["x.vel", *(f"scan_{i:03}.pos" for i in range(8)), "theta.vel"]


def config(environment: int = 3, **options: Any) -> MlpConfig:
    inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (10,))}
    if environment:
        inputs[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (environment,))
    made = MlpConfig(
        device="cpu",
        input_features=inputs,
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
        **{"hidden_dims": [16], "chunk_size": 4, **options},
    )
    made.set_dataset_feature_metadata({OBS_STATE: {"names": NAMES}})
    return made


def batch(made: MlpConfig, rows: int = 5, seed: int = 0) -> dict[str, Tensor]:
    """Return what LeRobot's loader and the preprocessor give, in normalised units."""
    generator = torch.Generator().manual_seed(seed)
    steps = () if made.n_obs_steps == 1 else (made.n_obs_steps,)
    result = {
        key: torch.randn(rows, *steps, ft.shape[0], generator=generator) for key, ft in made.input_features.items()
    }
    result[OBS_SCAN] = torch.rand(rows, *steps, 8, generator=generator) * 3 + 0.1
    result[ACTION] = torch.randn(rows, made.chunk_size, 2, generator=generator)
    result["action_is_pad"] = torch.zeros(rows, made.chunk_size, dtype=torch.bool)
    return result


def test_it_sees_every_number_once_oldest_first_and_beams_transformed() -> None:
    plain = MlpPolicy(made := config(n_obs_steps=2))
    given = batch(made)
    assert torch.equal(plain.features(given), torch.cat([given[OBS_STATE], given[OBS_ENV_STATE]], dim=-1).flatten(1))
    near = config(scan=ScanConfig(transform="inverse", minimum=0.1))
    nothing = {**batch(near), OBS_SCAN: torch.zeros(5, 8)}
    assert torch.equal(MlpPolicy(near).features(nothing)[:, 5:], torch.full((5, 8), 5.0))
    for transform, function in (("inverse", lambda r: 0.5 / r), ("log", lambda r: torch.log(r / 0.5))):
        made = config(scan=ScanConfig(transform=transform), n_obs_steps=2)
        policy, given = MlpPolicy(made), batch(made)
        seen = policy.features(given)
        others = torch.cat([given[OBS_STATE][..., [0, 9]], given[OBS_ENV_STATE]], dim=-1).flatten(1)
        assert (made.scan.start, made.scan.beams) == (1, 8)
        assert torch.equal(seen[:, :10], others)
        assert torch.allclose(seen[:, 10:], function(given[OBS_SCAN]).flatten(1))
        assert policy.feature_size == seen.shape[1] == 26


@each_case("steps", [1, 3])
@each_case("scan", [ScanConfig(), ScanConfig(transform="inverse"), ScanConfig(channels=[4])])
def test_what_is_ignored_changes_nothing_and_everything_else_does(steps: int, scan: ScanConfig) -> None:
    made = config(ignore=["*.vel"], n_obs_steps=steps, scan=scan)
    policy = MlpPolicy(made).eval()
    given = batch(made)
    chunk = policy.predict_action_chunk(given)
    ignored = [NAMES.index("x.vel"), NAMES.index("theta.vel")]
    for column in range(len(NAMES)):
        changed = {key: value.clone() for key, value in given.items()}
        changed[OBS_STATE][..., column] += 0.5
        if scan.transform != "none" and column not in ignored:
            changed[OBS_SCAN][..., column - 1] += 0.5
        assert torch.equal(chunk, policy.predict_action_chunk(changed)) == (column in ignored)


@each_case("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10"])
@each_case("spread", [0.0, 1e-5, 1.5e-3])
def test_what_was_constant_in_the_data_has_no_influence(tmp_path: Path, spread: float, mode: str) -> None:
    modes = {"STATE": mode, "ENV": mode, "ACTION": mode}
    made = config(min_std=1e-3, normalization_mapping={key: NormalizationMode[one] for key, one in modes.items()})

    def statistics(size: int, constant: int) -> dict[str, Any]:
        widths = np.full(size, 4.0)
        widths[constant] = spread
        low = 100 - widths / 2
        found = {"mean": low + widths / 2, "std": widths / 4, "min": low, "max": low + widths}
        return {**found, "q01": low, "q99": low + widths, "q10": low, "q90": low + widths}

    stats = {OBS_STATE: statistics(10, 3), OBS_ENV_STATE: statistics(3, 1), ACTION: statistics(2, 0)}
    before, after = make_pre_post_processors(made, dataset_stats=stats)
    for one in (before, after):
        one.save_pretrained(tmp_path)
    again, after = make_pre_post_processors(made, pretrained_path=str(tmp_path))
    for off in (0.0, 0.01, -1.0, 1e4):
        done = again({OBS_STATE: torch.full((1, 10), 100 + off), OBS_ENV_STATE: torch.full((1, 3), 100 + off)})
        assert abs(float(done[OBS_STATE][0, 3])) + abs(float(done[OBS_ENV_STATE][0, 1])) < 1e-4
        assert float(done[OBS_STATE][0, 0]) == pytest.approx(off if mode == "MEAN_STD" else off / 2, abs=1e-3)
    assert float(after(torch.zeros(1, 2))[0, 0]) == pytest.approx(100)  # an action is still what it was
    assert abs(float(after(torch.ones(1, 2))[0, 0]) - 100) < 2e-3  # and what hardly varied is not blown up


QUATERNIONS = [f"thing_{part}" for part in ("x", "qw", "qx", "qy", "qz")]


def with_things(things: int, **options: Any) -> MlpConfig:
    """Return a configuration whose environment state tells of things with an orientation."""
    made = config(environment=5 * things, **options)
    made.set_dataset_feature_metadata({OBS_STATE: {"names": NAMES}, OBS_ENV_STATE: {"names": QUATERNIONS * things}})
    return made


@pytest.mark.parametrize("steps", [1, 2])
def test_yaws_become_cosines_and_sines_of_their_multiples(tmp_path: Path, steps: int) -> None:
    made = with_things(2, yaw_harmonics=3, n_obs_steps=steps)
    assert made.environment_quaternions == [1, 6]
    policy = MlpPolicy(made).eval()
    turns = np.random.default_rng(0).uniform(-math.pi, math.pi, (4, steps, 2))
    tilts = Rotation.from_euler("xy", [0.2, -0.1])  # the yaw is that of the rotated x axis
    quaternions = (
        (Rotation.from_euler("z", turns.reshape(-1, 1)) * tilts).as_quat(scalar_first=True).reshape(4, steps, 2, 4)
    )
    pointing = Rotation.from_euler("z", turns.reshape(-1, 1)) * tilts
    ahead = pointing.apply([1.0, 0.0, 0.0])
    expected = np.arctan2(ahead[:, 1], ahead[:, 0]).reshape(4, steps, 2)
    environment = np.concatenate([np.zeros((4, steps, 2, 1)), quaternions], axis=-1).reshape(4, steps, 10)
    stats = {key: {"mean": np.full(size, 0.3), "std": np.full(size, 0.5)} for key, size in ((OBS_ENV_STATE, 10),)}
    before, after = make_pre_post_processors(made, dataset_stats=stats)
    for processor in (before, after):
        processor.save_pretrained(tmp_path)
    again, _ = make_pre_post_processors(made, pretrained_path=str(tmp_path))
    given = {OBS_STATE: torch.zeros(4, steps, 10), OBS_ENV_STATE: torch.tensor(environment, dtype=torch.float32)}
    if steps == 1:
        given = {key: value[:, 0] for key, value in given.items()}
    for one in (before, again):
        features = policy.features(one(given)).reshape(4, steps, -1)
        assert features.shape[-1] * steps == policy.feature_size
        wanted = np.concatenate([f(k * expected) for f in (np.cos, np.sin) for k in (1, 2, 3)], axis=-1)
        # In which order they stand is the network's affair.
        assert np.sort(features[..., 20:].numpy()) == pytest.approx(np.sort(wanted), abs=1e-5)


def test_turning_the_robot_turns_what_the_convolutions_see() -> None:
    torch.manual_seed(0)
    encoder = ScanEncoder(ScanConfig(channels=[4, 6], beams=16, start=0, stride=2), 1, nn.ReLU)
    scan = torch.rand(3, 1, 16)
    seen, turned = encoder(scan).unflatten(1, (6, 4)), encoder(scan.roll(4, -1)).unflatten(1, (6, 4))
    assert encoder.size == 24
    assert torch.allclose(seen.roll(1, -1), turned, atol=1e-6)
    assert not torch.allclose(seen, turned, atol=1e-3)


def test_cameras_are_left_alone() -> None:
    made = config()
    made.input_features["observation.images.front"] = PolicyFeature(FeatureType.VISUAL, (3, 8, 8))
    MlpPolicy(made)
    assert set(made.input_features) == {OBS_STATE, OBS_ENV_STATE}
    assert made.image_features == {}


@pytest.mark.law
@pytest.mark.parametrize("loss", ["l1", "mse", "huber", "nll"])
def test_the_loss_is_what_its_name_says_and_leaves_padding_out(loss: str) -> None:
    made = config(loss=loss, gaussian=loss == "nll", initial_log_std=-0.3)
    policy, given = MlpPolicy(made), batch(made)
    given["action_is_pad"][0, 1:] = True
    given["action_is_pad"][3, 3] = True
    with torch.no_grad():
        error = policy.predict_action_chunk(given) - given[ACTION]
        value, outputs = policy(given)
        each, _ = policy(given, reduction="none")
    wanted = {
        "l1": error.abs(),
        "mse": error**2,
        "huber": torch.where(error.abs() < 0.5, 0.5 * error**2, 0.5 * (error.abs() - 0.25)),
        "nll": -torch.distributions.Normal(0.0, math.exp(-0.3)).log_prob(error),
    }[loss]
    keep = ~given["action_is_pad"]
    assert float(value) == pytest.approx(float(wanted[keep].mean()), rel=1e-5)
    assert outputs["l1_loss"] == pytest.approx(float(error[keep].abs().mean()), rel=1e-5)
    rows = torch.stack([wanted[i][keep[i]].mean() for i in range(5)])
    assert torch.allclose(each, rows, rtol=1e-5)
    given[ACTION][~keep] = 1e6
    assert float(policy(given)[0].detach()) == pytest.approx(float(value))
    given["action_is_pad"][:] = True
    assert policy(given)[0].item() == 0


def test_it_learns_a_function_and_how_much_it_scatters() -> None:
    torch.manual_seed(0)
    made = config(0, gaussian=True, hidden_dims=[32], chunk_size=1, optimizer_lr=1e-2, layer_norm=True, dropout=0.1)
    policy = MlpPolicy(made)
    optimizer = made.get_optimizer_preset().build(policy.get_optim_params())
    noise = torch.tensor([0.1, 0.4])
    for step in range(250):
        policy.train()
        state = torch.randn(128, 10, generator=torch.Generator().manual_seed(step))
        action = state[:, :2].sin() + noise * torch.randn(128, 2, generator=torch.Generator().manual_seed(1000 + step))
        loss, outputs = policy({OBS_STATE: state, ACTION: action.unsqueeze(1)})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    state = torch.randn(256, 10, generator=torch.Generator().manual_seed(9999))
    error = policy.predict_action_chunk({OBS_STATE: state})[:, 0] - state[:, :2].sin()
    assert float(error.abs().mean()) < 0.15
    assert policy.log_std is not None
    assert policy.log_std.detach().exp()[0] == pytest.approx(noise.numpy(), abs=0.2)
    assert outputs["std"] == pytest.approx(float(policy.log_std.detach().exp().mean()), abs=0.05)


def test_where_two_ways_are_shown_it_takes_the_likelier_and_not_what_is_between_them() -> None:
    torch.manual_seed(0)
    made = config(0, modes=3, hidden_dims=[32], chunk_size=1, optimizer_lr=1e-2, scheduler="constant")
    policy = MlpPolicy(made)
    optimizer = made.get_optimizer_preset().build(policy.get_optim_params())
    for step in range(400):
        generator = torch.Generator().manual_seed(step)
        state = torch.randn(128, 10, generator=generator)
        # To the left or to the right, more often to the side of the first number; forward as the second says.
        is_left = torch.rand(128, generator=generator) < 0.5 + 0.2 * state[:, 0].sign()
        action = torch.stack([is_left.float() * 2 - 1, state[:, 1].sin()], dim=-1)
        loss, _ = policy({OBS_STATE: state, ACTION: action.unsqueeze(1)})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        given = {OBS_STATE: state, ACTION: action.unsqueeze(1)}
        assert policy(given, reduction="none")[0].mean().item() == pytest.approx(policy(given)[0].item(), abs=1e-5)
    state = torch.randn(256, 10, generator=torch.Generator().manual_seed(9999))
    state = state[state[:, 0].abs() > 0.3]
    turn, forward = policy.predict_action_chunk({OBS_STATE: state})[:, 0].T
    assert float((turn - state[:, 0].sign()).abs().median()) < 0.1
    assert float((turn.abs() < 0.7).float().mean()) < 0.02
    assert float((turn.sign() == state[:, 0].sign()).float().mean()) > 0.9
    assert float((forward - state[:, 1].sin()).abs().mean()) < 0.15


def test_samples_scatter_as_the_deviation_says() -> None:
    made = config(gaussian=True, initial_log_std=math.log(0.2))
    policy, given = MlpPolicy(made), batch(made, rows=1)
    mean = policy.predict_action_chunk(given)
    noise = torch.randn(mean.shape)
    assert torch.allclose(policy.predict_action_chunk(given, noise=noise), mean + 0.2 * noise)
    made.sample = True
    torch.manual_seed(1)
    drawn = torch.stack([policy.predict_action_chunk(given) for _ in range(500)])
    assert drawn.std(0).mean().item() == pytest.approx(0.2, rel=0.1)


def test_features_that_it_cannot_be_built_for() -> None:
    with pytest.raises(ConfigError, match="the dataset has neither"):
        MlpPolicy(MlpConfig(device="cpu", output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))}))
    made = config()
    made.output_features = {}
    with pytest.raises(ConfigError, match="needs an action"):
        MlpPolicy(made)
    made = config()
    made.input_features[OBS_STATE] = PolicyFeature(FeatureType.STATE, (2, 5))
    with pytest.raises(ConfigError, match=r"observation\.state has the shape \(2, 5\)"):
        MlpPolicy(made)
    features = {"input_features": config().input_features, "output_features": config().output_features}
    with pytest.raises(ConfigError, match=r"give policy\.ignored_columns"):
        MlpPolicy(MlpConfig(device="cpu", ignore=["*.vel"], **features))
    modes = dict.fromkeys(("STATE", "ENV", "ACTION"), NormalizationMode.MIN_MAX)
    made = config(residual=["x.vel"], residual_columns=[0, -1], normalization_mapping=modes)
    with pytest.raises(ConfigError, match=r"has MIN_MAX for STATE.*set MEAN_STD"):
        MlpPolicy(made)
    made = MlpConfig(device="cpu", scan=ScanConfig(transform="inverse"))
    with pytest.raises(ConfigError, match="does not have"):
        made.set_dataset_feature_metadata({OBS_STATE: {"names": ["a", "b"]}})
    with pytest.raises(ConfigError, match="make the policy before its processors"):
        make_pre_post_processors(made)


def test_batches_that_it_cannot_read() -> None:
    made = config(scan=ScanConfig(transform="log"), n_obs_steps=2)
    policy, given = MlpPolicy(made), batch(made)
    with pytest.raises(ConfigError, match="Run the policy's own preprocessor"):
        policy.features({key: value for key, value in given.items() if key != OBS_SCAN})
    with pytest.raises(ConfigError, match=r"trained with 'observation\.environment_state'"):
        policy.features({key: value for key, value in given.items() if key != OBS_ENV_STATE})
    with pytest.raises(ConfigError, match=r"holds 1 observations; policy\.n_obs_steps is 2"):
        policy.features({key: value[:, 0] for key, value in given.items()})
    with pytest.raises(ConfigError, match="nothing to sample from"):
        policy.predict_action_chunk(given, noise=torch.zeros(5, 4, 2))


def told_of_objects(rows: int = 40) -> Tensor:
    """Return environment states with one to five objects in random order, of which one is meant, shape (rows, 80)."""
    generator = torch.Generator().manual_seed(1)
    table = torch.randn(rows, 5, 16, generator=generator)
    count = torch.randint(1, 6, (rows,), generator=generator)
    table[..., 0] = (torch.arange(5) < count[:, None]).float()
    table[..., 1] = (torch.arange(5) == (torch.rand(rows, generator=generator) * count).long()[:, None]).float()
    return (table * table[..., :1]).flatten(1)


def test_a_policy_that_sorts_objects_does_the_same_in_any_order() -> None:
    made = config(
        environment=80,
        sort_objects=True,
        objects=[0, 5, 16, 0, 1, *range(3, 10)],
        yaw_harmonics=1,
        environment_quaternions=[6],
    )
    policy = MlpPolicy(made).eval()
    before, _ = make_pre_post_processors(made, dataset_stats=None)
    told = told_of_objects()
    state = torch.randn(len(told), 10)
    chunks = [
        policy.predict_action_chunk(before({OBS_STATE: state, OBS_ENV_STATE: rows}))
        for rows in (told, told.view(-1, 5, 16).flip(1).flatten(1))
    ]
    assert torch.equal(*chunks)


def test_actions_are_found_among_the_observations_by_their_names() -> None:
    actions, observed = ["a.pos", "b.pos", "grip.pos"], ["c.vel", "b.pos", "grip.pos", "a.pos"]
    assert residual_columns(["?.pos"], actions, observed) == [3, 1, -1]
    assert residual_columns([], actions, observed) == [-1, -1, -1]
    with pytest.raises(ConfigError, match=r"'x\*' matches no action .* a\.pos, b\.pos, grip\.pos"):
        residual_columns(["x*"], actions, observed)


def test_where_what_is_meant_is_from_the_tool_does_not_depend_on_where_both_are() -> None:
    start, count, size, fields = object_columns(list(ENVIRONMENT))
    step = ObjectOrderProcessorStep(start, count, size, fields, tuple(range(7)))
    generator = torch.Generator().manual_seed(2)
    told = told_of_objects().view(-1, 5, 16)
    quaternion = torch.from_numpy(Rotation.random(40, rng=np.random.default_rng(0)).as_quat(scalar_first=True)).float()
    tool = torch.cat([torch.randn(40, 3, generator=generator), quaternion], dim=1)
    seen = step.observation({OBS_STATE: tool, OBS_ENV_STATE: told.flatten(1)})[OBS_RELATIVE]
    shift = torch.tensor([0.3, -0.2, 0.1])
    moved = told.clone()
    moved[..., 3:6] += shift
    tool = torch.cat([tool[:, :3] + shift, tool[:, 3:]], dim=1)
    again = step.observation({OBS_STATE: tool, OBS_ENV_STATE: moved.flatten(1)})[OBS_RELATIVE]
    assert torch.allclose(seen, again, atol=1e-5)
    features = relative_features(seen, 2)
    assert features.shape == (40, relative_size(2))
    assert float(features.abs().max()) <= 1  # however far away


def poses(rows: int, seed: int) -> np.ndarray:
    """Return poses, shape (rows, 7), each quaternion of one of its two signs."""
    rng = np.random.default_rng(seed)
    quaternions = Rotation.random(rows, rng=rng).as_quat(scalar_first=True)
    return np.concatenate([rng.normal(size=(rows, 3)), quaternions * rng.choice((-1.0, 1.0), (rows, 1))], axis=1)


@pytest.mark.law
@pytest.mark.parametrize("steps", [1, 2])
def test_it_sees_where_the_target_is_from_the_tool(tmp_path: Path, steps: int) -> None:
    made = MlpConfig(
        device="cpu",
        hidden_dims=[16],
        n_obs_steps=steps,
        relative_target=True,
        input_features={
            OBS_STATE: PolicyFeature(FeatureType.STATE, (9,)),
            OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (8,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (2,))},
    )
    made.set_dataset_feature_metadata(
        {OBS_STATE: {"names": ["a.pos", *TOOL, "b.pos"]}, OBS_ENV_STATE: {"names": ["c", *TARGET]}}
    )
    policy = MlpPolicy(made)
    tool, target = poses(20 * steps, 0), poses(20 * steps, 1)
    target[0] = tool[0] * (1, 1, 1, -1, -1, -1, -1)
    state, told = np.pad(tool, ((0, 0), (1, 1))), np.pad(target, ((0, 0), (1, 0)))
    given = {
        key: torch.tensor(values, dtype=torch.float32).reshape((20, steps, -1) if steps > 1 else (20, -1))
        for key, values in ((OBS_STATE, state), (OBS_ENV_STATE, told))
    }
    for one in make_pre_post_processors(made, dataset_stats=None):
        one.save_pretrained(tmp_path)
    again, _ = make_pre_post_processors(made, pretrained_path=str(tmp_path))
    batch = again(given)
    turn = [Rotation.from_quat(one[:, 3:], scalar_first=True) for one in (tool, target)]
    wanted = np.concatenate([target[:, :3] - tool[:, :3], (turn[1] * turn[0].inv()).as_rotvec()], axis=1)
    np.testing.assert_allclose(batch[OBS_TARGET].reshape(-1, 6), wanted, atol=2e-3)  # in single precision
    np.testing.assert_allclose(batch[OBS_TARGET].reshape(-1, 6)[0], 0.0, atol=1e-3)
    features = policy.features(batch)
    assert features.shape == (20, policy.feature_size)
    assert policy.feature_size == steps * (9 + 8 + TARGET_SIZE)
    assert float(target_features(batch[OBS_TARGET]).abs().max()) <= 1  # however far away


@pytest.mark.law
def test_the_sign_of_a_quaternion_that_is_to_be_reached_is_of_no_account() -> None:
    features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (8,))}, {ACTION: PolicyFeature(FeatureType.ACTION, (8,))}
    made = MlpConfig(device="cpu", hidden_dims=[16], chunk_size=2, residual=["tool_*"])
    made.input_features, made.output_features = features
    made.set_dataset_feature_metadata({OBS_STATE: {"names": ["a.pos", *TOOL]}, ACTION: {"names": [*TOOL, "b.pos"]}})
    assert made.residual_quaternions == [3]
    rng = np.random.default_rng(0)
    stats = {key: {"mean": rng.normal(size=8), "std": rng.uniform(0.1, 0.4, 8)} for key in (OBS_STATE, ACTION)}
    policy = MlpPolicy(made, dataset_stats=stats)
    raw = np.pad(poses(40, 2), ((0, 0), (0, 1)))
    away = Rotation.from_rotvec(rng.normal(size=(40, 3)) * 0.2) * Rotation.from_quat(raw[:, 3:7], scalar_first=True)
    raw[:, 3:7] = away.as_quat(scalar_first=True)
    observed = np.pad(poses(40, 2), ((0, 0), (1, 0)))

    def loss(actions: np.ndarray) -> Tensor:
        rows, seen = (
            torch.tensor((values - stats[key]["mean"]) / stats[key]["std"], dtype=torch.float32)
            for key, values in ((ACTION, actions), (OBS_STATE, observed))
        )
        return policy({OBS_STATE: seen, ACTION: rows[:, None].repeat(1, 2, 1)}, reduction="none")[0]

    nearer = raw.copy()
    nearer[:, 3:7] *= np.sign((raw[:, 3:7] * observed[:, 4:]).sum(axis=1, keepdims=True))
    negative = raw * (1, 1, 1, -1, -1, -1, -1, 1)
    assert torch.allclose(loss(raw), loss(nearer), atol=1e-4)
    assert torch.allclose(loss(raw), loss(negative), atol=1e-4)
    policy.residual = None
    assert not torch.allclose(loss(raw), loss(negative), atol=1e-1)
