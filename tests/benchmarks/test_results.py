"""`make results`: the table of sections, commands that are run once, rows and their goals, and the page."""

import json
import math
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks._report import mean
from benchmarks.results import page
from benchmarks.results.rows import is_met, over_seeds, over_trainings
from benchmarks.results.runner import REPOSITORY, FailedError, Runner
from benchmarks.results.table import Table
from bhd_lerobot import plugin  # noqa: F401 - registers our policies
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.training.dagger.config import parse_aggregation, read_stages
from tests.cases import each_case

TABLE, KEPT = Table(Path("outputs/results")), REPOSITORY / "docs/reference/results.json"


def commands(section: dict[str, Any]) -> list[str]:
    parts = [(section["once"], {})] if "once" in section else []
    parts += [(part, {"seed": seed}) for part in section.get("parts", {}).values() for seed in TABLE.seeds]
    return [shlex.join(shlex.split(one)) for part, words in parts for one in TABLE.commands(part, **words)]


def test_the_page_says_what_was_measured() -> None:
    text, _ = page.write(TABLE, KEPT)
    assert text == KEPT.with_suffix(".md").read_text(encoding="utf-8"), "run: make results RESULTS=--kept"


@each_case("name", TABLE.sections)
def test_the_commands_of_a_section_are_those_of_the_page_and_their_options_are_valid(name: str) -> None:
    section = TABLE.sections[name]
    listed = commands(section)
    for part in page.read(TABLE, KEPT)[name].values():
        assert {one.command for one in part.commands} <= set(listed)
    assert not [one for one in listed if "{" in one]
    for command in set(listed):
        kind, *options = shlex.split(command)
        keys = [one.partition("=")[0] for one in options]
        assert len(set(keys)) == len(keys), f"an option is given twice: {command}"
        if kind == "bhd-record":
            parse(RecordConfig, options)
        elif kind == "bhd-eval":
            config = parse(EvalConfig, options)
            assert set(config.only or ()) <= set(config.brains)
        elif kind == "bhd-train":
            assert Path(options[0].partition("=")[2]).is_file()
            if "/dagger_" in options[0]:
                read_stages(parse_aggregation(options))
    outputs = [one for command in set(listed) for one in re.findall(r"--output_dir=(\S+)", command)]
    assert len(outputs) == len(set(outputs))


@each_case(
    ("goal", "met"),
    [
        ("at least 90 %", True),
        ("at least 90.1 %", False),
        ("lower end at least 80 %", True),
        ("upper end at least 1", False),
        ("at most 0.9 of 1", True),
        ("above 0.9", False),
        ("at least 0.9, its interval above 0.8", False),
        ("at least 0.9, its interval above 0.79", True),
    ],
)
def test_a_goal_is_for_the_value_or_the_end_that_it_names(goal: str, met: bool) -> None:
    assert is_met(goal, {"value": 0.9, "low": 0.8, "high": 0.95}) == met
    assert is_met("lower end at least 0.9", {"value": 0.9, "low": math.nan, "high": math.nan})  # no interval


def test_the_interval_over_trainings_is_over_the_episodes_that_they_share_too() -> None:
    # Of equal trainings it is what one of them would have, Wilson's; of many episodes Student's: 4.3027 / sqrt(3)
    # deviations to either side, within what a rate can be.
    assert over_seeds([0.9, 0.9, 0.9], 500) == "90.0 % (87.1 to 92.3); 90.0 %, 90.0 %, 90.0 %"
    assert over_seeds([0.1, 0.2, 0.3], 10**9) == "20.0 % (0.0 to 44.8); 10.0 %, 20.0 %, 30.0 %"
    assert over_seeds([0.97, 0.99, 1.0], 10**9) == "98.7 % (94.9 to 100.0); 97.0 %, 99.0 %, 100.0 %"
    for rates, episodes in (([0.1, 0.2, 0.3], 20), ([0.974, 0.974, 0.976], 500), ([1.0, 0.0, 0.0], 100)):
        found, value, rounding = over_trainings(rates, episodes), sum(rates) / 3, 0.5 / episodes + 1e-4
        own, half = wilson(round(value * episodes), episodes), 4.3027 * np.std(rates, ddof=1) / math.sqrt(3)
        assert found.low <= max(0.0, min(own.low, value - half) + rounding)
        assert found.high >= min(1.0, max(own.high, value + half) - rounding)
    for nothing in (math.nan, None):
        assert "1.000 (no interval" in mean({"value": 1.0, "low": nothing, "high": nothing})
    assert mean({"value": None, "low": None, "high": None}) == "–"


def ran(folder: Path) -> list[str]:
    return [json.loads(line)["command"] for line in (folder / "ran.jsonl").read_text(encoding="utf-8").splitlines()]


def test_a_command_is_run_once_and_what_a_stopped_one_left_is_removed(tmp_path: Path) -> None:
    made, log = tmp_path / "made", tmp_path / "logs/000.log"
    make = f"python -c \"import os; os.mkdir('{made}'); print('hello')\" --output_dir={made}"
    (made / "half").mkdir(parents=True)
    run = Runner(tmp_path)
    first = run.run(make)
    assert run.run(make) == first
    assert first.cpu_seconds > 0
    assert list(made.iterdir()) == []
    assert "hello" in log.read_text(encoding="utf-8")
    assert run.measure({"took": {"seconds": "seconds made"}}) == {"took": {"seconds": first.seconds}}
    with pytest.raises(FailedError, match=r"ended with status 2[\s\S]*out of order"):
        run.run("python -c \"print('out of order'); raise SystemExit(2)\"")
    with pytest.raises(FailedError, match="Another process makes results in"):
        Runner(tmp_path)
    run.close()
    assert Runner(tmp_path).run(make) == first  # as in another run
    assert len(ran(tmp_path)) == 1
