"""The commands that make other datasets out of datasets, as a user types them."""

import json
import shutil
from pathlib import Path

import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.cli.data.edit import parts_of
from bhd_lerobot.cli.data.episode_list import parse_episodes, short
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case
from tests.datasets.edit_support import content, record


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("edit") / "d", list(range(6)))


@pytest.mark.law
def test_merge_filter_delete_split_mark(recorded: Path, tmp_path: Path, capsys) -> None:
    whole = content(recorded)
    two = shutil.copytree(recorded, tmp_path / "two")
    assert main.main(["merge", str(recorded), str(two), "--output", str(tmp_path / "all")]) == 0
    assert content(tmp_path / "all") == whole + whole
    assert main.main(["delete", str(tmp_path / "all"), "--episodes", "0-5"]) == 0
    assert content(tmp_path / "all") == whole
    assert main.main(["mark", str(two), "--episodes", "1,3-4", "--outcome", "stuck", "--note", "wheel"]) == 0
    assert [episode.metadata["outcome"] for episode in dataset_info(two).episodes].count("stuck") == 3
    assert main.main(["filter", str(two), "--outcome", "success", "--output", str(tmp_path / "good")]) == 0
    assert content(tmp_path / "good") == [whole[0], whole[2], whole[5]]
    arguments = ["filter", str(two), "--episodes", "0-3", "--outcome", "stuck,timeout", "--output", str(tmp_path / "s")]
    assert main.main(arguments) == 0
    assert [one.task for one in content(tmp_path / "s")] == [whole[1].task, whole[3].task]
    assert main.main(["filter", str(recorded), "--min_score", "1", "--output", str(tmp_path / "best")]) == 0
    assert content(tmp_path / "best") == whole[4:]
    assert main.main(["split", str(recorded), "--parts", "train=0.5,val=0.5", "--output", str(tmp_path / "p")]) == 0
    assert content(tmp_path / "p/train") + content(tmp_path / "p/val") == whole
    assert main.main(["split", str(recorded), "--parts", "a=0,5;b=1-2", "--output", str(tmp_path / "q")]) == 0
    assert content(tmp_path / "q/a") == [whole[0], whole[5]]
    out = capsys.readouterr().out
    assert f"{tmp_path / 'all'}: 12 episodes" in out
    assert content(recorded) == whole


def test_check_with_fix(recorded: Path, tmp_path: Path, capsys) -> None:
    root = shutil.copytree(recorded, tmp_path / "d")
    (root / "meta/stats.json").unlink()
    assert main.main(["check", str(root), "--no-videos"]) == 1
    assert "bhd-data check --fix" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert main.main(["check", str(root), "--fix", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["valid"] is True
    assert captured.err.startswith("fixed meta/stats.json")


@each_case(
    ("arguments", "words"),
    [
        (["merge", "R", "--output", "X"], "at least two"),
        (["merge", "R", "N", "--output", "X"], "does not exist"),
        (["filter", "R", "--outcome", "sucess", "--output", "X"], "Did you mean 'success'"),
        (["filter", "R", "--outcome", "stuck", "--output", "X"], "No episode of"),
        (["filter", "N", "--outcome", "all", "--output", "X"], "does not exist"),
        (["filter", "R", "--output", "X"], "needs a selection of episodes: --episodes"),
        (["filter", "R", "--min_score", "2", "--output", "X"], "0 to 1"),
        (["delete", "R", "--episodes", "9"], "no episode 9"),
        (["delete", "R", "--episodes", "x"], "names no episode"),
        (["delete", "R", "--episodes", "5-1"], "runs backwards; write 1-5"),
        (["delete", "R", "--episodes", "0-99999999999"], "at most 1000000"),
        (["filter", "R", "--episodes", "0-2,1", "--output", "X"], "Episode 1 is named twice"),
        (["split", "R", "--parts", "a=1", "--output", "X"], "Write a=1.0 for the share, a=1-1 for the episode"),
        (["split", "R", "--parts", "a=0.5", "--shuffle_seed", "-1", "--output", "X"], "seeds start at 0"),
        (["split", "R", "--parts", "a=0.7,b=0.7", "--output", "X"], "at most 1 together"),
        (["split", "R", "--parts", "a=0.01", "--output", "X"], "would have no episode"),
        (["split", "R", "--parts", "a,b", "--output", "X"], "not one name and its part"),
        (["split", "R", "--parts", "../a=0.5", "--output", "X"], "not one name and its part"),
        (["split", "R", "--parts", "a=0.5,b=3", "--output", "X"], "at most 1 together"),
        (["split", "R", "--parts", "a=0.5,b=x", "--output", "X"], "no number"),
        (["mark", "R", "--episodes", "0"], "Give a mark"),
        (["mark", "R", "--episodes", "0", "--outcome", "good"], "Unknown outcome 'good'"),
        (["mark", "R", "--episodes", "0", "--intervention", "3..5"], "FIRST-LAST"),
        (["mark", "R", "--episodes", "0", "--intervention", "3-50"], "not frames of episode 0; valid: 0 to 4"),
    ],
)
def test_bad_input_ends_in_a_message(recorded: Path, tmp_path: Path, capsys, arguments: list[str], words: str) -> None:
    names = {"R": str(recorded), "X": str(tmp_path / "x"), "N": str(tmp_path / "none")}
    before = {path: path.stat().st_mtime_ns for path in recorded.rglob("*")}
    assert main.main([names.get(argument, argument) for argument in arguments]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    assert {path: path.stat().st_mtime_ns for path in recorded.rglob("*")} == before


def test_episode_lists_come_back() -> None:
    for text, numbers in (("0", [0]), ("0,3,5-7", [0, 3, 5, 6, 7]), ("[1, 2]", [1, 2]), ("4 6", [4, 6])):
        assert parse_episodes(text) == numbers
        assert parse_episodes(short(numbers)) == numbers
    for text in ("", "a", "1-", "-1", "1.5", "²", "1-2-3", "1;2", "9" * 13):
        with pytest.raises(ConfigError, match="names no episode"):
            parse_episodes(text)


def test_shares_are_dealt_out_completely() -> None:
    for total in (1, 7, 100):
        parts = parts_of("a=0.5,b=0.3,c=0.2", total, shuffle_seed=4)
        assert sorted(episode for part in parts.values() for episode in part) == list(range(total))
        assert parts == parts_of("a=0.5,b=0.3,c=0.2", total, shuffle_seed=4)
    assert parts_of("a=0.5,b=0.5", 100, 1) != parts_of("a=0.5,b=0.5", 100, 2)
    assert parts_of("a=0.5", 10) == {"a": [0, 1, 2, 3, 4]}
    assert parts_of(" a = 0.5, ü= 0.5 ", 4) == {"a": [0, 1], "ü": [2, 3]}
    assert parts_of("a=1-1", 4) == {"a": [1]}
    assert parts_of("a=1;b=0", 4) == {"a": [1], "b": [0]}
    assert parts_of("a=1.0", 2) == {"a": [0, 1]}
