"""bhd-eval with brains of other kinds: trained policies, and robots on the wall clock."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from tests.evaluation.test_evaluate import FAILING, results, run_eval

STATE = ("x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(36)))
ACTIONS = ("x.vel", "theta.vel")
LIVE = {
    "robot__clock": "realtime",
    "robot__realtime__brain_timeout_s": 20,
    "robot__realtime__recorder_timeout_s": 20,
    "robot__realtime__most_misses": 10**6,
}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """Return the folder of an untrained policy for the robot of these tests."""
    folder = tmp_path_factory.mktemp("policy")
    config = MlpConfig(
        device="cpu",
        hidden_dims=[16],
        chunk_size=4,
        n_action_steps=2,
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (len(STATE),))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(ACTIONS),))},
    )
    torch.manual_seed(0)
    sizes = {"observation.state": len(STATE), "action": len(ACTIONS)}
    stats = {
        key: {"mean": np.full(n, 0.1), "std": np.full(n, 0.3), "min": np.full(n, -1.0), "max": np.ones(n)}
        for key, n in sizes.items()
    }
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    for part in (get_policy_class(config.type)(config), before, after):
        part.save_pretrained(folder)
    PolicyContract(
        robot_type="turtlebot3", fps=10, observation_names=STATE, action_names=ACTIONS, environment_names=(), cameras={}
    ).save(folder)
    return folder


def test_a_checkpoint_is_compared_with_rules_and_gives_the_same_bytes_if_that_is_asked_for(checkpoint, tmp_path):
    brain = {"brains__net__type": "learned", "brains__net__path": checkpoint, "brains__net__exact": "true"}
    for name, n_envs in (("one", 1), ("four", 4)):
        run_eval(tmp_path / name, n_envs=n_envs, n_episodes=4, **brain, **FAILING)
    assert (tmp_path / "one" / "results.json").read_bytes() == (tmp_path / "four" / "results.json").read_bytes()
    written = results(tmp_path / "one")
    assert set(written["brains"]) == {"old", "new", "net"}
    assert written["config"]["brains"]["net"]["type"] == "learned"
    assert written["paired"]["net"]["baseline"] == "old"


def test_a_checkpoint_for_something_else_is_refused_by_name(checkpoint, tmp_path):
    with pytest.raises(ConfigError, match=r"^brains\.net: .*10"):
        run_eval(tmp_path, robot__fps=5, brains__net__type="learned", brains__net__path=checkpoint)
    with pytest.raises(ConfigError, match=r"brains\.net: .*nowhere"):
        run_eval(tmp_path, brains__net__type="learned", brains__net__path=tmp_path / "nowhere")


def test_an_evaluation_runs_on_the_wall_clock(tmp_path):
    result, printed = run_eval(tmp_path, only="[old]", n_episodes=2, task__duration_s=1, task__min_path_m=0.01, **LIVE)
    assert result.exit_status == 0
    assert "Emergency stop: " in printed
    episodes = result.results.episodes
    assert [episode.episode for episode in episodes] == [0, 1]
    assert all(episode.frames == 10 for episode in episodes)
    assert set(result.timing["brains"]["old"]["episodes"]) == {"0", "1"}
    assert all(episode.wall["inference_max_s"] > 0 for episode in episodes)
    assert "wall" not in (tmp_path / "results.json").read_text()
    assert "on the wall clock" in result.report.read_text()
