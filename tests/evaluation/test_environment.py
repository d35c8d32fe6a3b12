"""bhd-eval in LeRobot's environments: the outcomes of lerobot-eval, paired, and what cannot run is refused."""

import html
import json
import os
import re
import signal
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.cli.evaluate import main
from tests.cases import each_case
from tests.evaluation.line_env import LineEnv
from tests.policies.learned.stock_rig import run_stock
from tests.recording.support import save_mlp as save

EPISODES, BATCH, SEED = 5, 3, 5
BHD = ["--env.type=bhd", "--env.task=TurtleBot3Avoid-v0", "--env.robot={beams: 12}"]
BHD += ["--env.task_options={duration_s: 2, min_path_m: 0.3}"]
LINE = ["--env.discover_packages_path=tests.evaluation.line_env", "--env.type=line"]


class Compared(NamedTuple):
    """Two policies that were compared in an environment: its options, their folders, and the run's."""

    env: list[str]
    policies: dict[str, Path]
    folder: Path


@pytest.fixture(scope="module", params=["bhd", "line"])
def compared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "bhd":
        env, state, action = BHD, 14, ([0.18, 0.0], [0.1, 1.0])
    else:
        env, state, action = LINE, 2, ([0.2], [1.0])
    policies = {
        "sure": save(folder / "sure", 1, state, *action),
        "drawn": save(folder / "drawn", 2, state, *action, gaussian=True, sample=True),
    }
    brains = [f"--brains.{label}.path={path}" for label, path in policies.items()]
    run = [f"--n_episodes={EPISODES}", f"--n_envs={BATCH}", f"--seed={SEED}", f"--output_dir={folder / 'run'}"]
    assert main([*env, *brains, *run]) == 0
    return Compared(env, policies, folder / "run")


def results(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "results.json").read_text())


def test_every_episode_ends_as_in_lerobot_eval(compared: Compared, tmp_path: Path) -> None:
    """Also of a policy that draws its actions at random, after another one."""
    succeeded = []
    for label, path in compared.policies.items():
        options = [f"--policy.path={path}", "--policy.device=cpu", f"--seed={SEED}", f"--output_dir={tmp_path / label}"]
        batch = [f"--eval.n_episodes={EPISODES}", f"--eval.batch_size={BATCH}", "--eval.use_async_envs=false"]
        env = [option for option in compared.env if "discover" not in option]  # it is known in this process
        run_stock("lerobot-eval", [*env, *options, *batch])
        (theirs,) = json.loads((tmp_path / label / "eval_info.json").read_text())["per_task"]
        ours = [episode for episode in results(compared.folder)["episodes"] if episode["brain"] == label]
        assert [episode["success"] for episode in ours] == theirs["metrics"]["successes"]
        assert [episode["reward"] for episode in ours] == theirs["metrics"]["sum_rewards"]
        assert [episode["max_reward"] for episode in ours] == theirs["metrics"]["max_rewards"]
        assert [int(episode["seed"]) for episode in ours] == list(range(SEED, SEED + EPISODES))
        succeeded += theirs["metrics"]["successes"]
    assert len(set(succeeded)) == 2, "there was nothing to compare"


def test_policies_are_compared_episode_by_episode(compared: Compared) -> None:
    written = results(compared.folder)
    episodes = {label: [e for e in written["episodes"] if e["brain"] == label] for label in compared.policies}
    pair = written["paired"]["drawn"]
    assert (pair["baseline"], pair["episodes"]) == ("sure", EPISODES)
    for name in ("reward", "max_reward"):
        differences = [one[name] - other[name] for one, other in zip(episodes["drawn"], episodes["sure"], strict=True)]
        assert pair["rewards"][name]["value"] == pytest.approx(np.mean(differences))
    assert pair["rewards"]["reward"]["low"] < pair["rewards"]["reward"]["value"] < pair["rewards"]["reward"]["high"]
    for label, ran in episodes.items():
        one = written["brains"][label]
        assert one["successes"] == sum(episode["success"] for episode in ran)
        assert one["means"]["reward"]["value"] == pytest.approx(np.mean([episode["reward"] for episode in ran]))
        assert one["privileged"] is False
        for episode in ran:
            assert episode["outcome"] == "success" or not episode["success"]
            assert episode["length_s"] == episode["frames"] / written["config"]["env"]["fps"]
    assert pq.read_table(compared.folder / "episodes.parquet").num_rows == 2 * EPISODES


@pytest.mark.figures
def test_the_report_has_returns_where_there_are_no_scores(compared: Compared, tmp_path: Path) -> None:
    """It is drawn by the command that repeats the run, which writes the same results."""
    assert main([f"--config_path={compared.folder / 'config.yaml'}", f"--output_dir={tmp_path / 'again'}"]) == 0
    assert (tmp_path / "again/results.json").read_bytes() == (compared.folder / "results.json").read_bytes()
    page = re.sub(r'"data:[^"]*"', "", (tmp_path / "again" / "report.html").read_text(encoding="utf-8"))
    shown = html.unescape(page[page.index("<body") :].partition("<details><summary>config.yaml")[0])
    written = results(compared.folder)
    assert f"episodes of {written['config']['env']['type']} " in shown
    assert "<th>return, difference</th>" in shown
    assert "is_success" not in shown
    assert "<th>largest reward</th>" in shown
    assert not re.search("jerk|score|initial_states|nan|None", shown)
    for episode in written["episodes"]:
        again = f"--only=[{episode['brain']}]' --seed={episode['seed']} --n_episodes=1"
        assert (again in shown) == (not episode["success"])


@pytest.mark.parametrize("finished", [0, 2])
def test_a_signal_ends_the_run_with_the_batches_that_are_finished(finished, tmp_path, monkeypatch, capsys):
    step = LineEnv.step

    def pressed(self: LineEnv, action: Any) -> Any:
        if self.np_random_seed == SEED + finished * BATCH:
            os.kill(os.getpid(), signal.SIGTERM)
            monkeypatch.setattr(LineEnv, "step", step)
        return step(self, action)

    monkeypatch.setattr(LineEnv, "step", pressed)
    path = save(tmp_path / "policy", 1, 2, [0.0], [1.0])
    run = [f"--n_episodes={3 * BATCH}", f"--n_envs={BATCH}", f"--seed={SEED}", f"--output_dir={tmp_path / 'run'}"]
    brains = [f"--brains.{label}.path={path}" for label in ("one", "other")]
    assert main([*LINE, *run, *brains]) == 128 + signal.SIGTERM
    written = results(tmp_path / "run")
    assert written["partial"] is True
    assert [episode["brain"] for episode in written["episodes"]] == ["one"] * finished * BATCH
    assert "Stopped by SIGTERM: the results are partial" in capsys.readouterr().err


def test_an_environment_that_reports_no_success_is_warned_of(tmp_path, monkeypatch, capsys):
    """LeRobot counts its episodes as successes."""
    step = LineEnv.step
    monkeypatch.setattr(LineEnv, "step", lambda self, action: (*step(self, action)[:4], {}))
    path = save(tmp_path / "policy", 1, 2, [0.0], [1.0])
    assert main([*LINE, f"--brain.path={path}", "--n_episodes=2", f"--output_dir={tmp_path / 'run'}"]) == 0
    assert "does not report is_success" in " ".join(capsys.readouterr().err.split())
    assert "does not report is_success" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("finished", [0, 2])
def test_an_environment_that_fails_is_named_with_the_brain(finished, tmp_path, monkeypatch, capsys):
    """What was finished before is kept."""
    step = LineEnv.step

    def broken(self: LineEnv, action: Any) -> Any:
        if self.np_random_seed == SEED + finished * BATCH:
            raise ValueError("the line is cut")
        return step(self, action)

    monkeypatch.setattr(LineEnv, "step", broken)
    path = save(tmp_path / "policy", 1, 2, [0.0], [1.0])
    run = [f"--n_episodes={3 * BATCH}", f"--n_envs={BATCH}", f"--seed={SEED}", f"--output_dir={tmp_path / 'run'}"]
    assert main([*LINE, *run, f"--brains.mine.path={path}"]) == 2
    printed = capsys.readouterr().err
    assert "brains.mine: the policy" in printed
    assert "ValueError: the line is cut." in printed
    assert len(results(tmp_path / "run")["episodes"] if finished else []) == finished * BATCH
    assert (tmp_path / "run").exists() == bool(finished)


@each_case(
    ("options", "message"),
    [
        (["--env.type=lines"], "Unknown env.type 'lines'. Did you mean 'line'? Valid: aloha, bhd, "),
        (["--env.type=so101"], "once it is installed, if its name begins with lerobot_env_"),
        (["--env.type=pusht"], "pip install 'lerobot[pusht]'"),
        (["--env.task=Line-v0"], "env.type is missing"),
        ([*LINE, "--robot.type=ur5"], "env and robot are both given"),
        ([*LINE, "--robot.type=ur5", "--task.type=reach"], "env and robot and task are both given"),
        ([*LINE, "--env.speed=1"], "Unknown option 'env.speed'"),
        ([*LINE, "--env.task=Lines-v0"], "env.type is 'line', which"),
        ([*LINE, "--videos=1"], "Unknown option 'videos'"),
        ([*LINE, "--seed=4294967296"], "seed is 4294967296; it must be from 0 to 4294967295"),
        ([*LINE, "--brains.rule.type=noop"], "brains.rule.type is 'noop'; in an environment of LeRobot only policies"),
        ([*LINE, "--brain.stream=true"], "brains.learned.stream is True, which LeRobot's rollout does not have"),
        ([*LINE, "--brains.other.path=/nowhere"], "brains.other: There is no policy at '/nowhere'"),
        (BHD, "it reads 2 numbers in 'observation.state'; the environment returns 14"),
        (BHD, "its actions have 1 numbers, and those of the environment 2"),
    ],
)
def test_what_cannot_run_is_refused(options, message, tmp_path, capsys):
    path = save(tmp_path / "policy", 1, 2, [0.0], [1.0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "gym_pusht", None)  # as if it were not installed
        assert main([*options, f"--brain.path={path}", f"--output_dir={tmp_path / 'run'}"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
