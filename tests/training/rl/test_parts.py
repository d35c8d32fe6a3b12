"""What an actor begins as: the checkpoint that it starts from, seeing more than that did."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

pytest.importorskip("stable_baselines3")

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig, ScanConfig
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from bhd_lerobot.policies.mlp.scan_mlp import OBS_SCAN
from bhd_lerobot.policies.mlp.yaw_mlp import OBS_YAW
from bhd_lerobot.training.rl.config import parse_rl
from bhd_lerobot.training.rl.parts import seeing_more
from tests.cases import each_case

WIDTH, BEAMS, TASK = 14, 8, 9  # two numbers, the beams, four more numbers; the environment state
IGNORED = [0, 11, 13]
CASES = {
    "beams as numbers": {},
    "three observations": {"n_obs_steps": 3, "obs_stride": 2},
    "beams inverted": {"n_obs_steps": 2, "scan": ScanConfig(transform="inverse", start=2, beams=BEAMS)},
    "beams convolved": {
        "n_obs_steps": 2,
        "scan": ScanConfig(transform="log", start=2, beams=BEAMS, channels=[3], kernel_size=3, stride=2),
    },
    "yaws": {"yaw_harmonics": 2, "environment_quaternions": [3]},
    "no hidden layer": {"hidden_dims": []},
    "norms": {"layer_norm": True},
}


def policy(**values: object) -> MlpPolicy:
    torch.manual_seed(0)
    options = {"hidden_dims": [16], "chunk_size": 2, "n_action_steps": 1, **values}
    config = MlpConfig(device="cpu", push_to_hub=False, ignore=["?"], ignored_columns=IGNORED, **options)  # type: ignore[arg-type]
    config.input_features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (WIDTH,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (TASK,)),
    }
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    return MlpPolicy(config)


def batch(one: MlpPolicy, seed: int = 0) -> dict[str, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    steps = one.config.n_obs_steps
    rows = {
        "observation.state": torch.randn(5, steps, WIDTH, generator=draw),
        "observation.environment_state": torch.randn(5, steps, TASK, generator=draw),
    }
    if one.config.scan.is_used:
        rows[OBS_SCAN] = torch.rand(5, steps, BEAMS, generator=draw) + 0.2
    if one.config.yaw_harmonics:
        rows[OBS_YAW] = torch.randn(5, steps, 1, generator=draw)
    return rows


@pytest.mark.law
@each_case("case", CASES)
@each_case("steps", [None, (3, 2)])
def test_it_does_the_same_at_first_and_learns_from_what_it_did_not_see(case, steps):
    """Whatever the ignored numbers are, and what was before."""
    narrow = policy(**CASES[case] | ({} if steps is None else {"n_obs_steps": 1, "obs_stride": 1}))
    wide = seeing_more(narrow, ignored=True) if steps is None else seeing_more(narrow, ignored=True, steps=steps)
    assert (wide.config.ignore, wide.config.ignored_columns) == ([], [])
    assert narrow.config.ignored_columns == IGNORED  # the checkpoint's own is left alone
    if steps is not None:
        assert (wide.config.n_obs_steps, wide.config.obs_stride, wide.config.history) == (3, 2, 5)
    for seed in range(3):
        last, every = batch(narrow, seed), batch(wide, seed)
        for key, rows in every.items():
            rows[:, -last[key].shape[1] :] = last[key]
        before = narrow.predict_action_chunk(last)
        every["observation.state"][:, -last["observation.state"].shape[1] :, IGNORED] = 100.0 * (seed - 1)
        torch.testing.assert_close(wide.predict_action_chunk(every), before, rtol=1e-5, atol=1e-6)
    wide.train()
    wide({**batch(wide), "action": torch.full((5, 2, 2), 3.0)})[0].backward()
    first = wide.net[0].weight if steps is None or wide.scan_encoder is None else wide.scan_encoder.layers[0].weight
    unused = (first == 0).all(dim=0)
    assert unused.any()
    if steps is None:
        assert int(unused.sum()) == len(IGNORED) * wide.config.n_obs_steps
    assert (first.grad[:, unused].abs().sum(dim=0) > 0).all()


def test_seeing_what_is_ignored_needs_a_checkpoint() -> None:
    with pytest.raises(ConfigError, match="see_ignored is true; it needs --start_from"):
        parse_rl(["--config_path=configs/train/ppo_turtlebot3.yaml", "--see_ignored=true"])
    with pytest.raises(ConfigError, match="see_history is true; it needs --start_from"):
        parse_rl(["--config_path=configs/train/ppo_turtlebot3.yaml", "--see_history=true"])
    with pytest.raises(ConfigError, match=r"see_history is true; it needs --policy\.n_obs_steps"):
        parse_rl(["--config_path=configs/train/ppo_ur5_reach.yaml", "--see_history=true", "--start_from=x"])
