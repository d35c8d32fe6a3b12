"""Our way to open LeRobot's metadata gives what LeRobot's own gives."""

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from datasets.exceptions import DatasetGenerationError
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from bhd_lerobot.datasets.loader.metadata import Metadata
from bhd_lerobot.errors import DatasetCorruptError
from tests.datasets.loader import support
from tests.datasets.loader.support import FRONT, WRIST


def same(root: Path) -> None:
    """Check that both read the same there, or that both refuse it."""
    try:
        theirs = LeRobotDatasetMetadata("t/t", root=root)
    except DatasetGenerationError:
        with pytest.raises(DatasetCorruptError, match=r"file-001\.parquet is corrupt"):
            Metadata("t/t", root=root)
        return
    mine = Metadata("t/t", root=root)
    assert mine.episodes.features == theirs.episodes.features
    assert mine.episodes.to_list() == theirs.episodes.to_list()
    assert mine.episodes[1] == theirs.episodes[1]
    assert (mine.info, mine.total_episodes, mine.root) == (theirs.info, theirs.total_episodes, theirs.root)
    assert mine.tasks.equals(theirs.tasks)
    assert mine.stats.keys() == theirs.stats.keys()
    chosen = [meta.filter_episodes(lambda row: row["length"] > 6) for meta in (mine, theirs)]
    assert chosen[0] == chosen[1] != []


def test_the_same_as_lerobots(tmp_path: Path) -> None:
    same(support.record_light(tmp_path / "ours", 3, (FRONT, WRIST)))
    same(support.record_stock(tmp_path / "stock"))


def test_the_same_where_files_differ(tmp_path: Path) -> None:
    """In the order of their columns, as those that LeRobot merges do; in columns; and in types."""
    recorded = support.record_light(tmp_path / "recorded")
    path = next((recorded / "meta/episodes").glob("*/*.parquet"))
    table = pq.read_table(path)
    first, rest = table.slice(0, 2), table.slice(2)
    place, column = rest.column_names.index("length"), rest["length"]
    others = {
        "same": rest,
        "reversed": rest.select(rest.column_names[::-1]),
        "fewer": rest.drop_columns(["bhd/score"]),
        "more": rest.append_column("another", column),
        "damaged": None,
        **{str(kind): rest.set_column(place, "length", column.cast(kind)) for kind in (pa.int32(), pa.float64())},
    }
    for name, other in others.items():
        root = shutil.copytree(recorded, tmp_path / name)
        target = root / path.relative_to(recorded)
        pq.write_table(first, target)
        second = target.with_name("file-001.parquet")
        second.write_bytes(b"PAR1 and no more") if other is None else pq.write_table(other, second)
        same(root)


def test_what_is_not_there_is_looked_for_on_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = support.record_light(tmp_path / "d")
    next((root / "meta/episodes").glob("*/*.parquet")).unlink()
    asked: list[str] = []
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.get_safe_version", lambda repo, version: version)
    monkeypatch.setattr(Metadata, "_pull_from_repo", lambda *args, **options: asked.append(options["allow_patterns"]))
    with pytest.raises(FileNotFoundError, match="no Parquet file"):
        Metadata("t/t", root=root)
    assert asked == ["meta/"]
