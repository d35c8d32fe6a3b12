"""bhd-eval with brains of other kinds: trained policies, and robots on the wall clock."""

from pathlib import Path

import pytest

from bhd_lerobot.errors import ConfigError
from tests.evaluation.test_evaluate import FAILING, results, run_eval
from tests.recording.support import save_lidar_policy

LIVE = {"robot__clock": "realtime", "robot__realtime__brain_timeout_s": 20, "robot__realtime__most_misses": 10**6}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """Return the folder of an untrained policy for the robot of these tests."""
    folder = tmp_path_factory.mktemp("policy")
    return save_lidar_policy(folder)


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


@pytest.mark.thorough
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
