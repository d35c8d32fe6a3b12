"""Our way to open LeRobot's metadata gives what LeRobot's own gives."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from bhd_lerobot.datasets.loader.metadata import Metadata
from tests.datasets.loader import support
from tests.datasets.loader.support import FRONT, WRIST


def test_the_same_as_lerobots(tmp_path: Path) -> None:
    ours, stock = support.record_light(tmp_path / "ours", 3, (FRONT, WRIST)), support.record_stock(tmp_path / "stock")
    split = support.record_light(tmp_path / "split")
    first = next((split / "meta/episodes").glob("*/*.parquet"))
    table = pq.read_table(first)
    for number, rows in enumerate((table.slice(0, 2), table.slice(2))):
        pq.write_table(rows, first.with_name(f"file-{number:03d}.parquet"))
    for root in (ours, stock, split):
        mine, theirs = Metadata("t/t", root=root), LeRobotDatasetMetadata("t/t", root=root)
        assert mine.episodes.features == theirs.episodes.features
        assert mine.episodes.to_list() == theirs.episodes.to_list()
        assert mine.episodes[1] == theirs.episodes[1]
        assert (mine.info, mine.total_episodes, mine.root) == (theirs.info, theirs.total_episodes, theirs.root)
        assert mine.tasks.equals(theirs.tasks)
        assert mine.stats.keys() == theirs.stats.keys()
        chosen = [meta.filter_episodes(lambda row: row["length"] > 6) for meta in (mine, theirs)]
        assert chosen[0] == chosen[1] != []


def test_what_is_not_there_is_looked_for_on_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = support.record_light(tmp_path / "d")
    next((root / "meta/episodes").glob("*/*.parquet")).unlink()
    asked: list[str] = []
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.get_safe_version", lambda repo, version: version)
    monkeypatch.setattr(Metadata, "_pull_from_repo", lambda *args, **options: asked.append(options["allow_patterns"]))
    with pytest.raises(FileNotFoundError, match="no Parquet file"):
        Metadata("t/t", root=root)
    assert asked == ["meta/"]
