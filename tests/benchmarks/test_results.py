"""`make results`: rows of what benchmarks wrote, the page, commands that are run once, and the recovered share."""

import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks._turns import ratios, spread, write
from benchmarks.envs import BARE, OURS, TooLateError, summary, time_limit
from benchmarks.results import __main__ as program
from benchmarks.results import runner, trainings
from benchmarks.results.__main__ import MEASURES
from benchmarks.results.adaptation import recovered
from benchmarks.results.learning import values
from benchmarks.results.monitored import rows as monitored_rows
from benchmarks.results.page import write_page
from benchmarks.results.provenance import digests, provenance
from benchmarks.results.runner import REPOSITORY, FailedError, Ran, Runner, lock
from benchmarks.results.section import Row, Section, mean, over_seeds, over_trainings
from benchmarks.results.seeing import chance
from benchmarks.results.speed import envs_rows, evaluate_rows, images_rows, loader_rows, navigate_rows
from bhd_lerobot import plugin  # noqa: F401 - registers our policies
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_task
from bhd_lerobot.tasks.task import episode_seed
from bhd_lerobot.training.dagger.config import parse_aggregation, read_stages
from tests.cases import each_case
from tests.waiting import until

RATIO = {"median": 12.3, "low": 11.0, "high": 14.0, "turns": 3}


def test_a_spread_is_the_median_between_the_ends(tmp_path: Path) -> None:
    found = spread([3.0, 1.0, 10.0])
    assert found == {"median": 3.0, "low": 1.0, "high": 10.0, "turns": 3}
    assert ratios([2.0, 9.0], [1.0, 3.0]) == [2.0, 3.0]
    with pytest.raises(ValueError, match="zip"):
        ratios([1.0], [1.0, 2.0])
    write(tmp_path / "new" / "spread.json", found)
    assert json.loads((tmp_path / "new" / "spread.json").read_text(encoding="utf-8")) == found
    write(None, found)


def test_all_sections_have_names_of_their_own() -> None:
    names = [name for name, _, _ in MEASURES]
    assert len(set(names)) == len(names)
    assert {"avoid", "reach", "pick", "fine_tune", "navigate", "speed"} <= set(names)


# --- rows -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_met", [True, False])
def test_loader_rows_show_whether_the_goals_are_met(is_met: bool) -> None:
    one = {"samples_per_s": {"ours": RATIO}, "ratio": RATIO, "goal": 200.0, "met": is_met}
    rows = loader_rows({"state": one})
    assert [row.met for row in rows] == [None, is_met, False]  # the cameras' dataset was not recorded
    assert "12.3 x (11.0 to 14.0)" in rows[1].value
    assert rows[1].goal == "at least 200 x"
    assert "not measured" in rows[2].value


def test_what_did_not_come_up_is_listed_with_its_reason() -> None:
    speeds = {OURS: [70.0, 90.0], "SyncVectorEnv": [10.0, 10.0], BARE: [100.0, 100.0]}
    results = summary(speeds, {"AsyncVectorEnv": "64 environments did not come up within 300 s"}, 64)
    assert results["met"]
    assert results["ours_is"][BARE]["median"] == pytest.approx(0.8)
    rows = envs_rows(json.loads(json.dumps(results)))
    assert [row.met for row in rows] == [None, True, None, None]
    assert rows[1].value == "0.80 x (0.70 to 0.90)"
    assert rows[2].value.startswith("8.0 x")
    assert rows[3].value == "not measured: 64 environments did not come up within 300 s"
    assert not summary({**speeds, BARE: [200.0, 200.0]}, {}, 64)["met"]


def test_whole_trainings_are_shown_where_their_steps_alone_were_not_measured() -> None:
    """Of `benchmarks.images --whole`, as short runs have it."""
    programs = ("bhd-train", "lerobot-train")
    one = {f"{part}: {name}": RATIO for part in ("whole", "steps") for name in (*programs, "ratio")} | {"steps": 20}
    assert [row.met for row in images_rows({"training": {"bhd_cnn": one}})] == [None, True, None, None]
    whole = {key: value for key, value in one.items() if not key.startswith("steps: ")}
    rows = images_rows({"training": {"bhd_cnn": whole}})
    assert [row.what.partition(": ")[0] for row in rows] == ["learning bhd_cnn from images, a run of 20 steps"] * 2


def test_a_time_limit_ends_what_takes_too_long_and_nothing_else() -> None:
    with (
        pytest.raises(TooLateError, match=r"a long sleep did not come up within 0 s"),
        time_limit(0.05, "a long sleep"),
    ):
        time.sleep(60)
    with time_limit(60, "nothing"):
        pass


def test_evaluate_and_navigate_rows_carry_goals_and_numbers() -> None:
    speeds = {"lerobot-eval": RATIO, "bhd-eval": RATIO}
    evaluated: dict[str, Any] = {"task": "avoid", "policy": "bhd_mlp", "n_envs": 50, "episodes": 200, "compared": 600}
    evaluated |= {"episodes_per_s": speeds, "ratio": RATIO, "goal": 10.0, "met": True}
    rows = evaluate_rows({**evaluated, "same_success": 598, "largest_return_difference": 1e-7})
    assert "200 avoid episodes of bhd_mlp, 50 side by side" in rows[1].what
    assert (rows[1].goal, rows[1].met) == ("at least 10 x", True)
    assert rows[2].value.startswith("598 of 600")
    interval = {"value": 0.99, "low": 0.98, "high": 0.995}
    navigated = {
        "episodes": 500,
        "success": {**interval, "goal": 0.99, "met": True},
        "ends": {"success": 495, "collision": 5},
        "collisions": {"value": 5, "goal": 0, "met": False},
        "spl": {**interval, "goal": 0.85, "met": True},
    }
    rows = navigate_rows(navigated)
    assert [row.met for row in rows] == [True, False, True]
    assert rows[0].value == "99.0% (98.0% to 99.5%); 5 collision"


def test_the_interval_over_trainings_is_over_the_episodes_that_they_share_too() -> None:
    # Of equal trainings it is what one of them would have, Wilson's; of many episodes Student's: 4.3027 / sqrt(3)
    # deviations to either side, within what a rate can be.
    assert over_seeds([0.9, 0.9, 0.9], 500) == "90.0% (87.1% to 92.3%); 90.0%, 90.0%, 90.0%"
    assert over_seeds([0.1, 0.2, 0.3], 10**9) == "20.0% (0.0% to 44.8%); 10.0%, 20.0%, 30.0%"
    assert over_seeds([0.97, 0.99, 1.0], 10**9) == "98.7% (94.9% to 100.0%); 97.0%, 99.0%, 100.0%"
    for rates, episodes in (([0.1, 0.2, 0.3], 20), ([0.974, 0.974, 0.976], 500), ([1.0, 0.0, 0.0], 100)):
        found, value, rounding = over_trainings(rates, episodes), sum(rates) / 3, 0.5 / episodes + 1e-4
        own, half = wilson(round(value * episodes), episodes), 4.3027 * np.std(rates, ddof=1) / math.sqrt(3)
        assert found.low <= max(0.0, min(own.low, value - half) + rounding)
        assert found.high >= min(1.0, max(own.high, value + half) - rounding)
    for nothing in (math.nan, None):
        assert "1.000 (no interval" in mean({"value": 1.0, "low": nothing, "high": nothing})
    assert mean({"value": None, "low": None, "high": None}) == "–"
    low, high = (float(one) for one in re.findall(r"([\d.]+)%", over_seeds([0.90, 0.94, 0.98], 10**9))[1:3])
    # 94 % plus or minus 4.30 times the standard error, 2.31 %; and not what three episodes would say, 35 to 98 %.
    assert low == pytest.approx(84.1, abs=0.1)
    assert high == 100


@each_case(
    ("rate", "episodes", "alike", "spread"),
    [(0.9, 500, 1.0, 0.0), (0.97, 100, 1.0, 0.0), (0.5, 100, 0.5, 0.0), (0.9, 500, 0.0, 0.0), (0.8, 200, 0.5, 0.05)],
)
def test_the_interval_over_trainings_covers_the_rate_of_the_recipe(
    rate: float, episodes: int, alike: float, spread: float
) -> None:
    """In a share of the episodes all trainings end alike; their own rates differ by a standard deviation."""
    rng, tables = np.random.default_rng(0), 400
    covered = 0
    for _ in range(tables):
        shared, own = rng.random(episodes), rng.random((3, episodes))
        drawn = np.where(rng.random(episodes) < alike, shared, own)
        rates = (drawn < rate + spread * rng.standard_normal((3, 1))).mean(axis=1)
        found = over_trainings(rates.tolist(), episodes)
        covered += found.low <= rate <= found.high
    assert covered / tables > 0.92


@pytest.mark.parametrize("least", [1, 2])
def test_chance_is_how_often_a_drawn_object_is_the_one_that_is_meant(least: int) -> None:
    config = parse(EvalConfig, ["--config_path=configs/eval/ur5_pick_pixels.yaml", f"--task.min_objects={least}"])
    task, rng, hits, draws = make_task(config.task, 1, config.robot.fps, ur5()), np.random.default_rng(0), 0, 20_000
    scenes = [task.sample(episode_seed(config.seed, index, config.split)) for index in range(100)]
    for scene in (scenes[index % 100] for index in range(draws)):
        hits += rng.integers(len(scene.objects)) == scene.target_object
    assert chance(100, least) == pytest.approx(hits / draws, abs=0.015)


# --- fine-tuning ------------------------------------------------------------------------------------------------------


def test_the_recovered_share_is_of_what_was_lost() -> None:
    before, lost = [True] * 100, [True] * 20 + [False] * 80
    assert recovered(before, lost, lost) == (0.0, 0.0, 0.0)
    assert recovered(before, lost, before) == (1.0, 1.0, 1.0)
    share, low, high = recovered(before, lost, [True] * 60 + [False] * 40)
    assert share == pytest.approx(0.5)
    assert 0.3 < low < 0.5 < high < 0.7
    # Half of it again, and worse than before: below 0.
    share, _, high = recovered(before, lost, [False] * 100)
    assert share == pytest.approx(-0.25)
    assert high < 0


def test_a_share_of_nothing_is_not_defined() -> None:
    assert all(math.isnan(one) for one in recovered([True, False], [True, True], [True, True]))
    assert all(math.isnan(one) for one in recovered([], [], []))


def test_processor_time_counts_recordings_and_trainings_once_and_no_evaluation() -> None:
    record, train = Ran("bhd-record x", 20.0, 0, 10.0), Ran("bhd-train y", 20.0, 0, 5.0)
    assert trainings._making([record, train, Ran("bhd-eval z", 20.0, 0, 100.0), record]) == 15.0
    section = Section("see", "See", made_before={"here": {2, 0, 1}}, processor_s={1: 15.0, 0: 7.0})
    assert "Seeds 0, 1 and 2 were made here." in section.markdown()
    shown = [line for line in section.markdown() if "processor time of all" in line]
    assert [line.split("|")[2].strip() for line in shown] == ["7 s", "15 s"]


def test_the_interval_gets_narrower_with_more_seeds() -> None:
    rng = np.random.default_rng(0)
    widths = []
    for count in (50, 500):
        before, lost, found = (list(rng.random(count) < p) for p in (0.9, 0.3, 0.7))
        _, low, high = recovered(before, lost, found)
        widths.append(high - low)
    assert widths[1] < widths[0]


def test_outcomes_are_in_the_order_of_the_episodes() -> None:
    rows = [("a", 1, True), ("b", 0, True), ("a", 0, False)]
    results = {"episodes": [{"brain": name, "episode": number, "success": good} for name, number, good in rows]}
    assert values(results, "a", "success") == [False, True]


@each_case(
    ("failures", "score", "met"),
    [
        (5, 0.2, [True, True, True, False]),
        (6, 0.19, [False, False, True, False]),
        (0, 0.18, [True, False, False, False]),
        (0, 0.24, [True, True, True, True]),
    ],
)
def test_what_ppo_made_of_a_clone_is_compared_with_that_and_with_both_rules(
    failures: int, score: float, met: list[bool]
) -> None:
    def results(scores: dict[str, float], failed: int = 0) -> dict[str, Any]:
        rate = {"value": 0.9, "low": 0.8, "high": 1.0}
        brain = {"episodes": 10, "successes": 10 - failed, "success": rate, "outcomes": {"success": 10 - failed}}
        around = {name: [value + 0.01 * (-1) ** i for i in range(1000)] for name, value in scores.items()}
        return {"brains": {name: {**brain, "scores": values} for name, values in around.items()}}

    alone = results({"avoidance": 0.126, "clone": 0.2})
    behind, teacher = results({"clone": 0.15, "ppo": score}, failures), results({"gap_follower": 0.2})
    rows = monitored_rows(alone, behind, teacher, 7, is_start=False)
    assert [row.met for row in rows] == [None, None, None, *met[:2], None, *met[2:]]
    assert [row.what.partition(":")[0] for row in rows[:3]] == [
        "clone_7, from privileged state",
        "with the collision monitor, clone_7, from privileged state",
        "with the collision monitor, ppo_7, from privileged state",
    ]
    assert rows[3].value == str(failures)
    assert not any("kept the start" in row.value for row in rows)
    kept = monitored_rows(alone, behind, teacher, 7, is_start=True)
    assert [row.what.partition(":")[0] for row in kept if "PPO kept the start" in row.value] == [
        "ppo_7 / clone_7, both with the monitor"
    ]


def test_what_was_measured_names_the_commit_that_it_was_measured_with(tmp_path: Path) -> None:
    assert "commit" not in provenance(tmp_path)  # a folder that git knows nothing of

    def git(*arguments: str) -> str:
        name = ("-c", "user.name=one", "-c", "user.email=one@example.org")
        command = ["git", "-C", str(tmp_path), *name, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    git("init", "--quiet")
    assert "commit" not in provenance(tmp_path)  # nothing was committed yet
    (tmp_path / "bhd_lerobot").mkdir()
    source = tmp_path / "bhd_lerobot" / "brain.py"
    source.write_text("A = 1\n", encoding="utf-8")
    git("add", "--all")
    git("commit", "--quiet", "--message=first")
    (tmp_path / "README.md").write_text("No number depends on it.", encoding="utf-8")
    first = re.search(r", with commit ([0-9a-f]+), lerobot_robot_bhd ", provenance(tmp_path))
    assert first is not None
    assert git("rev-parse", "HEAD").startswith(first[1])
    source.write_text("A = 2\n", encoding="utf-8")
    assert f"commit {first[1]} and changes, " in provenance(tmp_path)


# --- sections ---------------------------------------------------------------------------------------------------------


class Pretended(Runner):
    """Reads the options of every command, and makes up what it would have written."""

    def run(self, name: str, arguments: Sequence[str], allowed: Sequence[int] = (0,), **_: Any) -> Ran:
        program, *options = arguments
        keys = [one.partition("=")[0] for one in options]
        assert len(set(keys)) == len(keys), f"{name} is given an option twice: {options}"
        if program == "bhd-record":
            parse(RecordConfig, options)
        elif program == "bhd-eval":
            self._results[name] = self._evaluated(parse(EvalConfig, options))
        elif program == "bhd-train":
            assert "--output_dir" in keys
            assert Path(options[0].partition("=")[2]).is_file()
            if "/dagger_" in options[0]:
                read_stages(parse_aggregation(options))
        command = shlex.join(arguments)
        self.commands.append(Ran(command, 12.0, 0, 10.0, configs=digests([command], REPOSITORY), made="on a day"))
        return self.commands[-1]

    def read(self, *parts: str) -> Any:
        if parts[-1] == "rounds.json":
            rate = {"value": 0.9, "low": 0.8, "high": 0.99}
            rounds = [{"round": number, "episodes": 10 * number, "success": rate} for number in (0, 1)]
            return {"rounds": [{**one, "seconds": 30.0} for one in rounds]}
        if parts[-1].endswith("refusals.json"):
            counts = {"tables": 10, "went": 1, "right": 0}
            return {"nominal": {"there": {**counts, "right": 1}, "absent": counts, "several": {**counts, "tables": 0}}}
        return self._results["/".join(parts[:-1])]

    _results: dict[str, Any]

    @staticmethod
    def _evaluated(config: EvalConfig) -> dict[str, Any]:
        names = config.only or list(config.brains)
        assert set(names) <= set(config.brains)
        rng, episodes, brains = np.random.default_rng(len(names)), [], {}
        for name in names:
            good = rng.random(config.n_episodes) < 0.9
            episodes += [
                {"brain": name, "episode": i, "success": bool(one), "score": float(0.1 + rng.random())}
                for i, one in enumerate(good)
            ]
            lost = int((~good).sum())
            rate = {"value": float(good.mean()), "low": 0.8, "high": 0.99}
            saw = {"episodes": config.n_episodes, "error_m": [0.002, 0.005, None], "wrong": rate, "in_90": rate}
            brains[name] = {
                **{"episodes": config.n_episodes, "successes": config.n_episodes - lost, "success": rate},
                **{"outcomes": {"success": config.n_episodes - lost, "timeout": lost}, "perception": saw},
                **{"means": {"score": {"value": 0.6, "low": None, "high": None}}},
            }
        return {"brains": brains, "episodes": episodes}


@pytest.mark.parametrize("is_short", [False, True])
def test_every_section_fills_its_table_from_what_its_commands_write(tmp_path: Path, is_short: bool) -> None:
    for name, title, measure in MEASURES:
        if name in {"navigate", "speed"}:  # benchmarks with files of their own
            continue
        sittings = (None,) if is_short else ((1,), (0, 2), None)
        for chosen in sittings:
            section, run = Section(name, title), Pretended(tmp_path, is_short=is_short, chosen=chosen)
            run._results = {}
            measure(run, section)
            text = "\n".join(section.markdown())
            assert "nan" not in text, name
            assert section.rows, name
            # Both ablations were measured, or it is said that there is nothing to be deaf or blind to.
            assert re.search(r"(?i)\bdeaf(_\d)?\b", text), name
            assert re.search(r"(?i)\bblind(_\d)?\b", text), name
            assert len({row.what for row in section.rows}) == len(section.rows), name
            # What was learned is shown of every training seed, or of all of them together; rules have none.
            for row in section.rows:
                rule = re.match(r"(avoidance|gap_follower|reach|pick|servo)\b(?!_)", row.what)
                if "success" in row.what and not rule:
                    assert re.search(r"(seed[_ ]|_)[012]\b|over [23] trainings", row.what), (name, row.what)
            commands = [one.command for one in run.commands]
            made = {int(seed) for command in commands for seed in re.findall(r"--seed=([012])\b", command)}
            wanted = {0} if is_short else ({1} if chosen == (1,) else {0, 1, 2})
            assert made == wanted, (name, chosen, made)
            outputs = [one for command in set(commands) for one in re.findall(r"--output_dir=(\S+)", command)]
            assert len(outputs) == len(set(outputs)), name


# --- training seeds ---------------------------------------------------------------------------------------------------


def test_training_seeds_are_made_in_any_sittings_and_shown_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in (trainings, runner):
        monkeypatch.setattr(module, "REPOSITORY", tmp_path)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs/inner.yaml").write_text("steps: 1")
    (tmp_path / "configs/outer.yaml").write_text("config: configs/inner.yaml")

    def sitting(
        *chosen: int, option: str = "", short: bool = False, width: int = 3
    ) -> tuple[dict[int, Any], Section, Runner]:
        section = Section("s", "S")
        folder = tmp_path / f"sitting_{chosen}{option}{short}{width}"
        run = Runner(folder, is_short=short, chosen=chosen, kept=tmp_path / "kept")

        def measure(seed: int) -> dict[str, Any]:
            code, policy = f"'configs/outer.yaml {option} --seed={seed} seed_{seed}/x'", f"policy_{seed}"
            ran = run.run(f"train_{seed}", ["python", "-c", code])
            (folder / policy).mkdir(exist_ok=True)
            save_file({"weight": np.full((width, 2), seed, np.float32)}, folder / policy / "model.safetensors")
            run.commands[-1] = replace(ran, makes=[str(folder / policy)])
            return {"rate": seed / 10, "series": (1.5, None)}

        return trainings.each(run, section, "part", (0, 1, 12), measure), section, run

    made, section, run = sitting(1)
    assert made == {1: {"rate": 0.1, "series": [1.5, None]}}
    assert section.made_before == {}
    made, section, run = sitting(0, 12)
    assert list(made) == [0, 1, 12]
    assert made[1] == {"rate": 0.1, "series": [1.5, None]}
    assert [re.findall(r"seed=(\d+)", one.command) for one in run.commands] == [["0"], ["1"], ["12"]]
    assert list(section.made_before.values()) == [{1}]
    assert sum(line.startswith("Seed 1 was made on ") for line in section.markdown()) == 1
    # What is short, or was made in another way, is not mixed with what was made before.
    assert list(sitting(0, 1, 12, short=True)[0]) == [0]
    assert list(sitting(1, option="--steps=2")[0]) == [1]
    assert "seed 12 was made by another recipe and is left out; make it with --seeds 12" in capsys.readouterr().out
    assert list(sitting(1)[0]) == [0, 1, 12]
    # A change of a policy's code changes its network, if not its configuration.
    assert list(sitting(1, width=4)[0]) == [1]
    assert list(sitting(1)[0]) == [0, 1, 12]
    (tmp_path / "configs/inner.yaml").write_text("# a comment\nsteps: 1")
    made, _, run = sitting(12)
    assert list(made) == [0, 1, 12]
    before = run.commands[-1]
    # What the same folder has of another configuration is made anew.
    (tmp_path / "configs/inner.yaml").write_text("steps: 2")
    made, _, run = sitting(12)
    assert list(made) == [12]
    assert run.commands[-1].seconds != before.seconds
    assert json.loads((tmp_path / "kept/part_12.json").read_text())["configs"] == run.commands[-1].configs


def test_a_section_of_earlier_trainings_says_nothing_of_this_checkout(tmp_path: Path) -> None:
    before = Section("one", "One", commands=[Ran("train", 1.0, 0)], made_before={"on 2020-01-01, with version 1": {0}})
    write_page(tmp_path / "page.md", [before], ["One"], is_short=False)
    assert "\nMade on 2020-01-01, with version 1.\n" in (tmp_path / "page.md").read_text(encoding="utf-8")


def test_the_page_says_what_was_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, kept = REPOSITORY / "docs/reference/results.md", tmp_path / "results.md"
    shutil.copy(page, kept)
    shutil.copytree(page.with_suffix(""), kept.with_suffix(""))
    assert program.main(["--kept", f"--page={kept}"]) == 0
    written = kept.read_text(encoding="utf-8")
    assert written == page.read_text(encoding="utf-8"), "run: make results RESULTS=--kept"
    # Nothing is run, and nothing is lost, where a command is not on the page.
    kept.write_text(written.replace("--dataset.num_episodes=200 --n_envs=32", "--n_envs=32"), encoding="utf-8")
    before = kept.read_bytes()
    assert program.main(["--kept", f"--page={kept}", "--only", "avoid"]) == 2
    assert "(avoid_record) is not on" in capsys.readouterr().err
    assert kept.read_bytes() == before


def test_every_rate_of_picks_from_pixels_has_chance_beside_it_and_scores_come_before_success() -> None:
    page = (REPOSITORY / "docs/reference/results.md").read_text(encoding="utf-8")
    rows = {
        title: re.findall(r"^\| (.*?) \| (.*?) \|", _section(page, title), re.MULTILINE)
        for title in ("from pix", "front cam")
    }
    rates = [(what, value) for what, value in rows["from pix"] if re.match(r"[\d.]+% \(", value)]
    assert rates
    for what, value in rates:
        assert re.search(r"; chance (45\.4|42\.2|31\.8|54\.6|57\.8)%$", value), what
    names = [what for what, _ in rows["front cam"]]
    for name in ("avoidance", "clone_0", "blind_0", "seed_0"):
        assert names.index(f"{name}: mean score") < min(
            i for i, one in enumerate(names) if one.startswith(f"{name}: success")
        )


def _section(page: str, words: str) -> str:
    (text,) = (one for one in page.split("\n## ")[1:] if words in one.partition("\n")[0])
    return text


# --- page and runner --------------------------------------------------------------------------------------------------


def test_a_command_is_run_once_and_again_when_it_changed(tmp_path: Path) -> None:
    run = Runner(tmp_path, is_short=True)
    first = run.run("note", ["python", "-c", "print('hello')"])
    again = run.run("note", ["python", "-c", "print('hello')"])
    assert again == first
    assert "hello" in (tmp_path / "notes" / "note.log").read_text(encoding="utf-8")
    assert run.commands == [first, first]
    missed = run.run("note", ["python", "-c", "raise SystemExit(1)"], allowed=(0, 1))
    assert missed.status == 1
    with pytest.raises(FailedError, match=r"ended with status 3[\s\S]*out of order"):
        run.run("note", ["python", "-c", "print('out of order'); raise SystemExit(3)"])


def test_a_command_of_a_short_run_does_what_it_does_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There it is forked from a process that has imported it; that it is killed is a failure like any other."""
    monkeypatch.setattr(runner, "_IMPORTED", ("tests.preloaded",))  # there is one such process, for all tests
    written: list[set[str]] = []
    for is_short in (False, True):
        folder = tmp_path / str(is_short)
        descriptor = lock(folder)
        run = Runner(folder, is_short=is_short, lock=descriptor)
        with pytest.raises(FailedError, match="ended with status 2"):
            run.run("wrong", ["bhd-data", "info", str(tmp_path / "nowhere")])
        helped = run.run("help", ["bhd-data", "--help"])
        assert helped.cpu_seconds > 0
        assert helped.command == "bhd-data --help"
        written.append({(folder / "notes" / f"{name}.log").read_text(encoding="utf-8") for name in ("wrong", "help")})
        os.close(descriptor)
    dying = "import os, signal\ndef main():\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    (tmp_path / "dying.py").write_text(dying, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(runner._MODULES, "bhd-killed", "dying")
    with pytest.raises(FailedError, match="ended with status -9"):
        Runner(tmp_path, is_short=True).run("killed", ["bhd-killed"])
    assert written[0] == written[1]
    assert all("bhd-data" in text or "nowhere" in text for text in written[0])


def test_what_a_stopped_command_left_is_in_nobodys_way(tmp_path: Path) -> None:
    run = Runner(tmp_path, is_short=True)
    # As our commands do: they refuse a folder that is there.
    refuses = ["python", "-c", f"import os; os.mkdir({str(tmp_path / 'made')!r})"]
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "half").write_text("")
    with pytest.raises(FailedError, match="exists"):
        run.run("note", refuses)
    first = run.run("note", refuses, makes=("made", "never_made"))
    assert run.run("note", refuses, makes=("made", "never_made")) == first
    assert not list((tmp_path / "made").iterdir())
    (tmp_path / "made" / "whole").write_text("")
    run.run("note", [*refuses[:2], f"{refuses[2]} # changed"], makes=("made",))
    assert not list((tmp_path / "made").iterdir())


def test_what_reads_something_that_was_made_anew_is_made_anew(tmp_path: Path) -> None:
    def script(text: str, *paths: Path) -> list[str]:
        return ["python", "-c", text, *map(str, paths)]

    write = "import sys, pathlib as p; d = p.Path(sys.argv[1]); d.mkdir(exist_ok=True); (d / 'x').write_text({!r})"
    copy = (
        "import sys, pathlib as p; d = p.Path(sys.argv[2]); d.mkdir(exist_ok=True); "
        "(d / 'x').write_text((p.Path(sys.argv[1]) / 'x').read_text()); (d / 'times').open('a').write('1')"
    )

    def make(text: str) -> tuple[str, str]:
        run = Runner(tmp_path, is_short=True)  # as in another sitting
        run.run("data", script(write.format(text), tmp_path / "data"), makes=("data",))
        run.run("other", script(write.format("o"), tmp_path / "data-2"), makes=("data-2",))
        run.run("read", script(copy, tmp_path / "data", tmp_path / "read"), resumes=("read",))
        run.run("last", script(copy, tmp_path / "read", tmp_path / "last"), makes=("last",))
        return tuple((tmp_path / "last" / name).read_text() for name in ("x", "times"))

    assert make("a") == ("a", "1")
    ended = {path: path.stat().st_mtime_ns for path in (tmp_path / "notes").iterdir()}
    assert make("a") == ("a", "1")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "notes").iterdir()} == ended
    # Stopped after the data were made: the next sitting knows.
    run = Runner(tmp_path, is_short=True)
    run.run("data", script(write.format("b"), tmp_path / "data"), makes=("data",))
    assert make("b") == ("b", "1")
    assert (tmp_path / "read" / "times").read_text() == "1"
    # What is called much the same is something else.
    (tmp_path / "notes" / "other.json").unlink()
    ended = {name: (tmp_path / "notes" / f"{name}.json").stat().st_mtime_ns for name in ("read", "last")}
    make("b")
    assert {name: (tmp_path / "notes" / f"{name}.json").stat().st_mtime_ns for name in ended} == ended


def test_a_missed_goal_is_the_exit_status_of_a_full_run_and_only_counted_in_a_short_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def measure(_: Runner, section: Section) -> None:
        section.rows.append(Row("a number", "1", "at least 2", met=False))

    monkeypatch.setattr(program, "GROUPS", ())
    monkeypatch.setattr(program, "LAST", ("one", "One", measure))
    monkeypatch.setattr(program, "MEASURES", (program.LAST,))
    for options, status, words in (([], 3, "Missed: one: a number."), (["--short"], 0, "full run: 1 are missed")):
        folder = tmp_path / f"run_{status}"
        assert program.main([f"--folder={folder}", f"--page={folder}.md", *options]) == status
        assert words in capsys.readouterr().out
        assert "**missed**" in Path(f"{folder}.md").read_text(encoding="utf-8")


def test_sections_run_side_by_side_and_one_that_fails_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def busy(run: Runner, section: Section) -> None:
        run.run(section.name, ["python", "-c", "sum(range(30_000_000))"])
        section.rows.append(Row("a number", "1", "", met=True))

    def idle(run: Runner, section: Section) -> None:
        run.run(section.name, ["python", "-c", "pass"])

    def broken(run: Runner, _: Section) -> None:
        run.run("broken", ["python", "-c", "raise SystemExit(3)"])

    groups = ((("busy", "Busy", busy),), (("broken", "Broken", broken),), (("idle", "Idle", idle),))
    monkeypatch.setattr(program, "GROUPS", groups)
    monkeypatch.setattr(program, "LAST", ("last", "Last", idle))
    monkeypatch.setattr(program, "MEASURES", (*(one for group in groups for one in group), program.LAST))
    options = [f"--folder={tmp_path}", f"--page={tmp_path / 'page.md'}", "--jobs=3"]
    assert program.main(options) == 2
    assert "broken: python -c 'raise SystemExit(3)'" in capsys.readouterr().err
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert [line[3:] for line in text.splitlines() if line.startswith("## ")] == ["Busy", "Idle", "Last"]
    used = {name: json.loads((tmp_path / "notes" / f"{name}.json").read_text()) for name in ("busy", "idle")}
    assert used["busy"]["cpu_seconds"] > 3 * used["idle"]["cpu_seconds"]
    assert program.main([*options, "--only", "idle"]) == 0


_LONG = """
import sys
from benchmarks.results import __main__ as program

def long(run, section):
    endless = "import os, pathlib, time; made = pathlib.Path({made!r}); made.mkdir(); "
    endless += "(made / 'new').write_text(str(os.getpid())); (made / 'new').rename(made / 'pid'); time.sleep(600)"
    run.run("long", ["python", "-c", endless], makes=("made",))

program.LAST = ("last", "Last", lambda run, section: None)
program.GROUPS = ((("long", "Long", long),),)
program.MEASURES = (*program.GROUPS[0], program.LAST)
sys.exit(program.main(sys.argv[1:]))
"""


def test_two_runs_in_one_folder_do_not_remove_what_the_other_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(program, "GROUPS", ())  # should it not be refused, it shall at least not take hours
    monkeypatch.setattr(program, "LAST", ("last", "Last", lambda *_: None))
    pid, options = tmp_path / "made" / "pid", [f"--folder={tmp_path}", f"--page={tmp_path / 'page.md'}"]
    command = [sys.executable, "-c", _LONG.format(made=str(tmp_path / "made")), *options]
    first = subprocess.Popen(command, cwd=REPOSITORY)
    try:
        until(pid.exists, "the first run makes something")
        for fresh in ([], ["--fresh"]):
            assert program.main([*options, *fresh]) == 2
        first.kill()
        first.wait()
        # What it ran goes on, and nothing that it makes is removed.
        assert program.main(options) == 2
        assert pid.exists()
    finally:
        first.kill()
        if pid.exists():
            os.kill(int(pid.read_text()), signal.SIGKILL)
    assert capsys.readouterr().err.count("by another process, or by a command that a killed one left running") == 3
    until(lambda: _is_free(tmp_path), "the command has ended")


def test_a_folder_that_is_none_is_refused_and_fresh_removes_what_a_run_made_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit):
        program.main([f"--folder={tmp_path}", "--short", "--seeds", "1", "2"])
    assert "--short makes training seed 0 only" in capsys.readouterr().err
    assert program.main([f"--folder={tmp_path / 'file'}"]) == 2
    assert "file cannot be used as a folder: File exists. Name another: --folder" in capsys.readouterr().err
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "results"
    for one in (elsewhere / "notes", elsewhere):
        one.mkdir(parents=True, exist_ok=True)
        (one / "kept").write_text("")
    monkeypatch.setattr(program, "GROUPS", ())
    monkeypatch.setattr(program, "LAST", ("last", "Last", lambda *_: None))
    options = [f"--page={tmp_path / 'page.md'}", "--only", "avoid"]
    assert program.main([f"--folder={folder}", *options]) == 0
    made = list(folder.iterdir())
    (folder / "notes").mkdir()
    (folder / "notes" / "one.json").write_text("")
    (folder / "link").symlink_to(elsewhere)
    assert program.main([f"--folder={folder}", *options, "--fresh"]) == 0
    assert list(folder.iterdir()) == made
    assert program.main([f"--folder={elsewhere}", *options]) == 0
    assert program.main([f"--folder={elsewhere}", *options, "--fresh"]) == 2
    assert "elsewhere has no file .made_by_results" in capsys.readouterr().err
    assert (elsewhere / "kept").exists()
    assert (elsewhere / "notes" / "kept").exists()
    assert (tmp_path / "file").read_text() == "mine"


def _is_free(folder: Path) -> bool:
    try:
        os.close(lock(folder))
    except FailedError:
        return False
    return True


def test_a_run_that_is_stopped_begins_nothing_else_and_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun = []

    def interrupted(run: Runner, _: Section) -> None:
        run.run("first", ["python", "-c", "pass"])
        begun.append("first")
        signal.pthread_kill(cast(int, threading.main_thread().ident), signal.SIGINT)
        until(lambda: run._stopped is not None and run._stopped.is_set(), "the run was stopped")
        run.run("second", ["python", "-c", "pass"])
        begun.append("second")

    monkeypatch.setattr(program, "GROUPS", ((("one", "One", interrupted),), (("two", "Two", interrupted),)))
    monkeypatch.setattr(program, "MEASURES", (("one", "One", interrupted), ("two", "Two", interrupted), program.LAST))
    assert program.main([f"--folder={tmp_path}", f"--page={tmp_path / 'page.md'}"]) == 130
    assert begun == ["first"]
    assert "goes on with what is not done yet" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        program.main(["--jobs=0"])
    assert "--jobs is 0; it must be at least 1" in capsys.readouterr().err


def test_the_page_shows_numbers_goals_verdicts_and_commands(tmp_path: Path) -> None:
    section = Section("speed", "Speed", [Row("a", "1 x"), Row("b", "2 x", "at least 3 x", met=False)], ["A remark."])
    ran = Runner(tmp_path, is_short=True).run("note", ["python", "-c", "pass"])
    section.commands = [ran, replace(ran, command="bhd-train"), ran]
    page = tmp_path / "results.md"
    write_page(page, [section], ["Speed"], is_short=True)
    text = page.read_text(encoding="utf-8")
    assert "## Speed" in text
    assert "| a | 1 x |  |  |" in text
    assert "| b | 2 x | at least 3 x | **missed** |" in text
    assert "A remark." in text
    assert re.findall(r"^(.*)   # ", text, re.MULTILINE) == ["python -c pass", "bhd-train"]
    assert "not to be quoted" in text
    write_page(page, [section], ["Speed"], is_short=False)
    assert "not to be quoted" not in page.read_text(encoding="utf-8")


def test_sections_that_were_not_made_stay_on_the_page_in_their_order(tmp_path: Path) -> None:
    page, titles = tmp_path / "results.md", ["Avoid: a robot roams", "Reach", "Speed"]
    for name, value in (("Speed", "1 x"), ("Reach", "90 %"), ("Avoid: a robot roams", "99 %"), ("Gone", "0 %")):
        write_page(page, [Section("", name, [Row("a number", value)])], [*titles, "Gone"], is_short=False)
    before = page.read_text(encoding="utf-8")
    write_page(page, [Section("", "Reach", [Row("a number", "95 %")])], titles, is_short=False)
    text = page.read_text(encoding="utf-8")
    assert [line[3:] for line in text.splitlines() if line.startswith("## ")] == titles
    assert text.count("\nMade on ") == 3
    assert text == before.partition("\n## Gone")[0].replace("90 %", "95 %")
