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
from tests.datasets.edit_support import content, record


@pytest.mark.law
def test_merge_filter_delete_split_mark(six_episodes: Path, tmp_path: Path, capsys) -> None:
    whole = content(six_episodes)
    two, more = shutil.copytree(six_episodes, tmp_path / "two"), record(tmp_path / "more", [6, 7])
    merged = ["merge", str(more), str(six_episodes), str(two), "--output", str(tmp_path / "all")]
    assert main.main(merged) == 0
    assert content(tmp_path / "all") == content(more) + whole
    assert main.main(["delete", str(tmp_path / "all"), "--episodes", "0-1"]) == 0
    assert content(tmp_path / "all") == whole
    assert main.main(["mark", str(two), "--episodes", "1,3-4", "--outcome", "stuck", "--note", "wheel"]) == 0
    assert [episode.metadata["outcome"] for episode in dataset_info(two).episodes].count("stuck") == 3
    assert main.main(["filter", str(two), "--outcome", "success", "--output", str(tmp_path / "good")]) == 0
    assert content(tmp_path / "good") == [whole[0], whole[2], whole[5]]
    arguments = ["filter", str(two), "--episodes", "0-3", "--outcome", "stuck,timeout", "--output", str(tmp_path / "s")]
    assert main.main(arguments) == 0
    assert [one.task for one in content(tmp_path / "s")] == [whole[1].task, whole[3].task]
    assert main.main(["filter", str(six_episodes), "--min_score", "1", "--output", str(tmp_path / "best")]) == 0
    assert content(tmp_path / "best") == whole[4:]
    assert main.main(["split", str(six_episodes), "--parts", "train=0.5,val=0.5", "--output", str(tmp_path / "p")]) == 0
    assert content(tmp_path / "p/train") + content(tmp_path / "p/val") == whole
    assert main.main(["split", str(six_episodes), "--parts", "a=0,5;b=1-2", "--output", str(tmp_path / "q")]) == 0
    assert content(tmp_path / "q/a") == [whole[0], whole[5]]
    out = capsys.readouterr().out
    assert f"{tmp_path / 'all'}: 8 episodes" in out
    assert f"left out: 6 episodes of {two}, which a dataset before it has, too: 0, 1, 2, 3, 4, 5\n" in out
    assert content(six_episodes) == whole


def test_check_with_fix(six_episodes: Path, tmp_path: Path, capsys) -> None:
    root = shutil.copytree(six_episodes, tmp_path / "d")
    (root / "meta/stats.json").unlink()
    assert main.main(["check", str(root), "--no-videos"]) == 1
    assert "bhd-data check --fix" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert main.main(["check", str(root), "--fix", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["valid"] is True
    assert captured.err.startswith("fixed meta/stats.json")


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
