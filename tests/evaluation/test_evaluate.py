"""bhd-eval: the same bytes for any number of simulations and twice, the same episodes for every brain, and its ends."""

import html
import io
import itertools
import json
import os
import re
import shlex
import signal

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from bhd_lerobot.cli.evaluate import main
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import BhdError, ConfigError, DatasetMismatchError
from bhd_lerobot.evaluation import evaluate as evaluate_module
from bhd_lerobot.evaluation import run as evaluation_run
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import EvalResult, evaluate
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.rollout import provenance
from bhd_lerobot.tasks.task import episode_seed
from tests.forks import Fork
from tests.recording.support import command_line, data_columns, episode_rows, run_record


def options(folder, **overrides) -> list[str]:
    values = {
        "robot.type": "turtlebot3",
        "robot.beams": 36,
        "task.type": "avoid",
        "task.duration_s": 3,
        "task.min_path_m": 0.2,
        "brains.old.type": "avoidance",
        "brains.new.type": "gap_follower",
        "n_episodes": 5,
        "n_envs": 3,
        "videos": 0,
        "output_dir": folder,
    }
    return command_line(values, overrides)


def run_eval(folder, **overrides) -> tuple[EvalResult, str]:
    console = Console(file=io.StringIO(), width=160)
    result = evaluate(parse(EvalConfig, options(folder, **overrides)), console)
    return result, console.file.getvalue()


def results(folder) -> dict:
    return json.loads((folder / "results.json").read_text())


# What a success needs is set so that some of these short episodes fail: 0.3 m in 3 s from a standing start.
FAILING = {"task__min_path_m": 0.55}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("eval") / "whole"
    result, printed = run_eval(folder, n_episodes=9, n_envs=1, threads=1, **FAILING)
    return folder, result, printed


def test_the_same_bytes_by_the_command_in_the_report_and_for_any_number_of_simulations(whole):
    """`test_runs_are_recorded…` compares a third number of simulations."""
    command = re.search("<pre>(bhd-eval .*)</pre>", (whole[0] / "report.html").read_text(encoding="utf-8"))
    assert command is not None
    words = shlex.split(html.unescape(command[1]))
    assert main([*words[1:], "--n_envs=16", "--threads=2"]) == 0
    again = whole[0].with_name("whole_again")
    assert (again / "results.json").read_bytes() == (whole[0] / "results.json").read_bytes()
    with np.load(whole[0] / "initial_states.npz") as one, np.load(again / "initial_states.npz") as other:
        assert set(one.files) == {"state_old", "episode_old", "state_new", "episode_new"}
        assert all(np.array_equal(one[name], other[name]) for name in one.files)


def test_who_acts_on_what_no_sensor_tells_is_marked_everywhere(tmp_path):
    """The rule `navigator` is told where its goal is; `gap_follower` is not, though the task tells it."""
    task = {"task__type": "navigate", "task__duration_s": 1, "task__min_path_m": None, "n_episodes": 1, "n_envs": 1}
    brains = {"brains__old__type": "navigator", "brains__new__type": "gap_follower"}
    result, printed = run_eval(tmp_path, **task, **brains)
    assert {label: one["privileged"] for label, one in results(tmp_path)["brains"].items()} == {
        "old": True,
        "new": False,
    }
    assert result.report.read_text(encoding="utf-8").count('"badge">privileged state<') == 1
    assert printed.count("(privileged)") == 1


def test_brains_get_the_same_episodes_which_are_held_out(whole):
    folder, result, _ = whole
    by_brain = {label: [e for e in result.results.episodes if e.brain == label] for label in ("old", "new")}
    for old, new in zip(*by_brain.values(), strict=True):
        assert (old.episode, old.seed, old.initial_state) == (new.episode, new.seed, new.initial_state)
        assert old.digest != new.digest  # what they did with it is their own
        assert old.seed == episode_seed(0, old.episode, "held_out")
    assert len({one.initial_state for one in by_brain["old"]}) == 9
    with np.load(folder / "initial_states.npz") as states:
        assert np.array_equal(states["state_old"], states["state_new"])
        assert states["episode_new"].tolist() == list(range(9))


def test_other_brains_and_episodes_beside_it_change_nothing(whole, tmp_path):
    result, _ = run_eval(tmp_path, only="[new]", episodes="[7,2]", n_episodes=9, **FAILING)
    alone = {episode.episode: episode for episode in result.results.episodes}
    assert sorted(alone) == [2, 7]
    for episode in whole[1].results.episodes:
        if episode.brain == "new" and episode.episode in alone:
            assert episode == alone[episode.episode]


def test_another_seed_and_split_are_other_episodes(whole, tmp_path):
    seen = {episode.seed for episode in whole[1].results.episodes}
    for name, overrides in (("a", {"seed": 1}), ("b", {"split": "train"})):
        result, _ = run_eval(tmp_path / name, only="[old]", n_episodes=2, **overrides)
        assert not seen & {episode.seed for episode in result.results.episodes}


def test_counts_and_files_agree(whole):
    folder, _, printed = whole
    written = results(folder)
    rows = pq.read_table(folder / "episodes.parquet").to_pylist()
    assert len(written["episodes"]) == len(rows) == 18
    assert written["partial"] is False
    for label, one in written["brains"].items():
        mine = [row for row in rows if row["brain"] == label]
        assert one["episodes"] == len(mine) == 9
        assert one["successes"] == sum(row["success"] for row in mine)
        assert sum(one["outcomes"].values()) == 9
        assert one["success"]["low"] <= one["success"]["value"] <= one["success"]["high"]
        assert one["means"]["score"]["value"] == pytest.approx(np.mean([row["score"] for row in mine]))
        assert one["frames"] == sum(row["frames"] for row in mine)
        assert one["limits"]["acceleration"] == sum(row["limits.acceleration"] for row in mine) > 0
        for row in mine:
            assert row["path_m"] == pytest.approx(row["details.path_m"], abs=0.05)  # the task's own count
            assert row["length_s"] == row["frames"] / 10
    pair = written["paired"]["new"]
    assert pair["baseline"] == "old"
    new, old = (written["brains"][label]["means"]["score"]["value"] for label in ("new", "old"))
    assert pair["score"]["value"] == pytest.approx(new - old)
    assert set(written["brains"]["old"]["outcomes"]) | set(written["brains"]["new"]["outcomes"]) > {"success"}
    assert "9 held-out episodes" in printed
    timing = json.loads((folder / "timing.json").read_text())
    assert timing["brains"]["old"]["act"]["calls"] >= 9 * 20
    assert 0 < timing["brains"]["old"]["act"]["p50_s"] <= timing["brains"]["old"]["act"]["p99_s"]


def test_nothing_of_the_wall_clock_is_in_the_results(whole):
    text = (whole[0] / "results.json").read_text()
    for word in ("wall", "per_s", "n_envs", "threads", "output_dir", str(whole[0])):
        assert word not in text


def test_an_episode_equals_the_one_that_is_recorded(whole, tmp_path):
    """bhd-record with the same seed and split has the same episodes."""
    run_record(tmp_path / "d", split="held_out", task__min_path_m=FAILING["task__min_path_m"], dataset__num_episodes=9)
    recorded = [row.metadata for row in dataset_info(tmp_path / "d").episodes]
    old = [episode for episode in whole[1].results.episodes if episode.brain == "old"]
    assert [(r["seed"], r["score"], r["outcome"]) for r in recorded] == [(str(o.seed), o.score, o.outcome) for o in old]


def test_runs_are_recorded_as_a_dataset_for_each_brain(whole, tmp_path):
    run_eval(tmp_path / "e", n_episodes=9, record__repo_id="me/eval", record__root=tmp_path / "data", **FAILING)
    for label in ("old", "new"):
        info = dataset_info(tmp_path / "data" / label)
        mine = [episode for episode in whole[1].results.episodes if episode.brain == label]
        assert [row.metadata["score"] for row in info.episodes] == [one.score for one in mine]
        assert [row.frames for row in info.episodes] == [one.frames for one in mine]
    assert (tmp_path / "e" / "results.json").read_bytes() == (whole[0] / "results.json").read_bytes()


RECORDED = {"record__repo_id": "me/eval", "n_episodes": 9, **FAILING}


def killed_at(brain, call, arguments):
    """Run bhd-eval, and end the process at once at a call of a brain."""
    calls, act = itertools.count(1), brain.act

    def acting(self, seen):
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return act(self, seen)

    brain.act = acting
    return main(arguments)


def test_a_killed_evaluation_runs_the_missing_episodes_and_ends_as_if_nothing_had_happened(whole, tmp_path):
    recorded = {**RECORDED, "record__root": tmp_path / "data", "n_envs": 2}
    for brain, call in ((AvoidanceBrain, 95), (GapFollowerBrain, 60)):
        killed = Fork(killed_at, brain, call, options(tmp_path / "e", **recorded))
        assert killed.wait() == -signal.SIGKILL
        assert not (tmp_path / "e" / "results.json").exists()
    result, printed = run_eval(tmp_path / "e", **recorded)
    assert "old: 9 episodes of 9 had been recorded before, and were not run again." in printed
    assert re.search(r"new: [2-7] episodes? of 9 had been recorded before", printed)
    assert (tmp_path / "e" / "results.json").read_bytes() == (whole[0] / "results.json").read_bytes()
    assert list(result.timing["brains"]) == ["new"]
    with np.load(whole[0] / "initial_states.npz") as one, np.load(tmp_path / "e" / "initial_states.npz") as other:
        assert all(np.array_equal(one[name], other[name]) for name in one.files)
    run_eval(tmp_path / "f", **RECORDED, record__root=tmp_path / "undisturbed")
    for label in ("old", "new"):
        roots = [tmp_path / folder / label for folder in ("undisturbed", "data")]
        assert data_columns(roots[0]) == data_columns(roots[1])
        assert episode_rows(roots[0]) == episode_rows(roots[1])


@pytest.mark.thorough
def test_partial_results_of_the_same_evaluation_are_completed_and_no_others(whole, tmp_path, monkeypatch):
    recorded = {**RECORDED, "record__root": tmp_path / "data"}
    with pytest.MonkeyPatch.context() as patch:
        act, calls = GapFollowerBrain.act, itertools.count(1)
        patch.setattr(
            GapFollowerBrain,
            "act",
            lambda self, seen: (next(calls) == 45 and os.kill(os.getpid(), signal.SIGTERM), act(self, seen))[1],
        )
        result, printed = run_eval(tmp_path / "e", **recorded)
    assert result.exit_status == 143
    assert "The same command runs the missing episodes." in printed
    assert "--resume" not in printed
    with pytest.raises(ConfigError, match="holds the results of an evaluation"):
        run_eval(tmp_path / "e", **{**recorded, "seed": 1})
    run_eval(tmp_path / "e", **recorded)
    with pytest.raises(ConfigError, match=r"holds the results of an evaluation.*--output_dir"):
        run_eval(tmp_path / "e", **recorded)
    assert (tmp_path / "e" / "results.json").read_bytes() == (whole[0] / "results.json").read_bytes()
    # Episodes of another evaluation, or of other versions, are not taken for those of this one.
    with pytest.raises(DatasetMismatchError, match=r"recording\.seed: recorded 0, requested 1") as caught:
        run_eval(tmp_path / "f", **{**recorded, "seed": 1})
    assert "--resume" not in str(caught.value)
    now = {**provenance.versions(), "mujoco": "5.0"}
    monkeypatch.setattr(evaluation_run, "versions", lambda: now)
    with pytest.raises(DatasetMismatchError, match=r"recorded with mujoco .*, now 5\.0.*--record\.root"):
        run_eval(tmp_path / "f", **recorded)


def test_a_failed_episode_is_run_again_by_the_command_in_the_report(whole, tmp_path):
    from bhd_lerobot.evaluation.report import replay_command

    config = parse(EvalConfig, [f"--config_path={whole[0] / 'config.yaml'}"])
    failed = next(episode for episode in whole[1].results.episodes if not episode.success)
    words = shlex.split(replay_command(config, whole[0], failed))
    assert words[0] == "bhd-eval"
    assert main(words[1:]) == 0
    (again,) = results(whole[0] / f"{failed.brain}_{failed.episode:04d}")["episodes"]
    assert again == failed.plain()


def test_a_sequential_test_ends_a_run_that_is_certain_and_says_so(tmp_path):
    """The rule `noop` never drives the distance that a success needs; after 8 such pairs the e-value is 2^8 / 9."""
    brains = {"brains__old__type": "noop", "n_episodes": 40, "n_envs": 4, "sequential": "true"}
    result, printed = run_eval(tmp_path / "e", **brains)
    written = results(tmp_path / "e")
    assert [written["brains"][label]["episodes"] for label in ("old", "new")] == [8, 8]
    assert written["partial"] is False
    pair = written["paired"]["new"]
    assert pair["e_value"] == pytest.approx(2**8 / 9)
    assert pair["differ"]["p"] == pytest.approx(9 / 2**8)
    assert pair["success"]["low"] > 0
    sentence = (
        "The sequential test ended the run after 8 of 40 pairs of episodes: e-value against equal success new 28.4"
    )
    for text in (printed, result.report.read_text(encoding="utf-8")):
        assert sentence in text
        assert "are not exact" in text
    assert "Stopped" not in printed
    assert "Newcombe" not in result.report.read_text(encoding="utf-8")


def test_a_signal_keeps_finished_episodes_and_marks_the_results_as_partial(whole, tmp_path, monkeypatch):
    calls = 0
    act = GapFollowerBrain.act

    def acting(self, seen):
        nonlocal calls
        calls += 1
        if calls == 45:  # in the second brain's second episode: 30 frames each
            os.kill(os.getpid(), signal.SIGTERM)
        return act(self, seen)

    monkeypatch.setattr(GapFollowerBrain, "act", acting)
    result, printed = run_eval(tmp_path, n_episodes=9, n_envs=1, **FAILING)
    assert result.exit_status == 143
    written = results(tmp_path)
    assert written["partial"] is True
    assert written["brains"]["old"]["episodes"] == 9
    finished = written["brains"]["new"]["episodes"]
    assert 1 <= finished < 9
    reference = {(one["brain"], one["episode"]): one for one in results(whole[0])["episodes"]}
    assert all(reference[one["brain"], one["episode"]] == one for one in written["episodes"])
    assert written["paired"]["new"]["episodes"] == finished
    assert "partial" in printed
    assert "Partial:" in (tmp_path / "report.html").read_text()


def test_a_signal_before_anything_is_finished_still_ends_in_a_report(tmp_path, monkeypatch):
    monkeypatch.setattr(
        AvoidanceBrain, "act", lambda self, seen: (os.kill(os.getpid(), signal.SIGINT), np.zeros((3, 2)))[1]
    )
    result, _ = run_eval(tmp_path)
    assert result.exit_status == 130
    assert results(tmp_path)["episodes"] == []
    assert "ran no episode" in (tmp_path / "report.html").read_text()


def test_fail_below_is_about_the_lower_end_of_the_interval(tmp_path):
    result, printed = run_eval(tmp_path / "a", fail_below=0.9)
    assert all(brain.success.value == 1 for brain in result.results.brains.values())
    assert result.exit_status == 1  # 5 of 5 is not yet 90 %
    assert result.missed == ["old", "new"]
    assert "old missed fail_below" in printed
    assert main(options(tmp_path / "b", fail_below=0.5)) == 0


def test_a_path_alone_is_a_checkpoint(monkeypatch):
    seen = []
    monkeypatch.setattr("bhd_lerobot.cli.evaluate.run", lambda program, arguments, *_: seen.append(arguments) or 0)
    main(["--brain.path=outputs/x"])
    main(["--brain.path", "outputs/x", "--brain.type=other"])
    assert seen[0] == ["--brain.path=outputs/x", "--brain.type=learned"]
    assert "--brain.type=learned" not in seen[1]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        run_eval(tmp_path / "file" / "run")


def test_a_full_disk_still_shows_the_numbers(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(evaluate_module, "write_json", full)
    console = Console(file=io.StringIO(), width=160)
    with pytest.raises(BhdError, match=r"No space left on device.*run it again"):
        evaluate(parse(EvalConfig, options(tmp_path, only="[old]", n_episodes=1)), console)
    assert "old" in console.file.getvalue()
