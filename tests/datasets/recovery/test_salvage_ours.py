"""Damage of what our recorder saved: every whole episode is recovered, and lost columns are named."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.datasets.edit.edits import delete, edits_of, keep
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.recovery import salvage as guard
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetCorruptError, DatasetError, DatasetMismatchError
from bhd_lerobot.tasks.task import Event
from tests.datasets import support
from tests.datasets.edit_support import assert_valid, content, record

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("ours") / "d", [0, 1, 2, 3], video=True)


def copied(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))


def cut(size: int) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, path.stat().st_size - size)


def without_metadata(root: Path) -> list[Any]:
    return [(one.task, one.columns, one.videos) for one in content(root)]


@pytest.mark.law
@pytest.mark.parametrize("is_ours", [True, False])
def test_data_without_a_footer_are_recovered_and_nothing_is_lost(recorded: Path, tmp_path: Path, is_ours: bool) -> None:
    for size in (1, 1000):
        root = copied(recorded, tmp_path / f"Dr. Smith {size}")
        if not is_ours:
            (root / "meta/bhd.json").unlink()
        cut(size)(root / DATA)
        with pytest.raises(ConfigError, match="Leave --info out"):
            repair(root, recorded)
        before = support.snapshot(root)
        remedies = [finding.remedy for finding in check_dataset(root).findings if finding.where == DATA]
        assert remedies
        assert all("bhd-data repair" in remedy for remedy in remedies)
        report = repair(root)
        assert (report.episodes, report.lost) == (4, ())
        assert "lost: nothing" in str(report)
        assert f"What was wrong: {root / DATA} is corrupt" in str(report)
        assert "in which no episode is whole" in str(report)
        assert report.aside is not None
        assert support.snapshot(report.aside) == before
        assert content(root) == content(recorded)
        assert_valid(root)
        assert not repair(root)
        if not is_ours:
            continue
        # It was edited, so nobody goes on as if nothing had happened.
        with pytest.raises(DatasetMismatchError, match="recovered"):
            support.resume(root, video=True)
        assert edits_of(root)[-1]["episodes"] == [0, 1, 2, 3]
        assert dataset_info(root).recording["seed"] == 1


@pytest.mark.parametrize("damage", [cut(20), Path.unlink, lambda path: shutil.rmtree(path.parents[1])])
def test_episodes_without_rows_are_recovered_and_lost_columns_are_named(recorded, tmp_path, damage):
    root = copied(recorded, tmp_path / "d")
    damage(root / EPISODES)
    remedies = [finding.remedy for finding in check_dataset(root).findings]
    assert any("bhd-data repair" in remedy for remedy in remedies)
    assert not any("removes" in remedy for remedy in remedies)
    with pytest.raises(DatasetCorruptError, match=r"episodes are not described, 0 first|magic bytes"):
        dataset_info(root)
    report = repair(root)
    assert report.episodes == 4
    assert without_metadata(root) == without_metadata(recorded)
    (lost,) = report.lost
    assert lost.startswith("meta/episodes: ")
    assert "bhd/" in lost
    assert lost.endswith("of episodes 0 to 3")
    assert_valid(root)


def test_readable_rows_keep_their_columns(tmp_path: Path) -> None:
    """An interrupted recording has a file for each episode."""
    root = tmp_path / "d"
    support.killed(root, 3)
    cut(20)(root / "meta/episodes/chunk-000/file-001.parquet")
    report = repair(root)
    assert report.episodes == 3
    assert [episode.metadata.get("seed") for episode in dataset_info(root).episodes] == [0, None, 2]
    assert report.lost == ("meta/episodes: bhd/ok, bhd/outcome, bhd/score, bhd/seed, bhd/start of episode 1",)


def test_an_unfinished_recording_is_still_finished_and_can_be_resumed(tmp_path: Path) -> None:
    root = tmp_path / "d"
    support.killed(root, 2).begin_episode()
    assert repair(root).aside is None
    assert edits_of(root) == []
    with support.resume(root) as recorder:
        support.record(recorder)
    assert support.verify(root, 3, stats=True) == 3


def with_events(root: Path, endings: list[Event]) -> Path:
    """Record episodes whose last frames tell how they ended, as `bhd-record` does."""
    features = {
        "observation.state": {"dtype": "float32", "shape": (1,), "names": ["x"]},
        "event": {"dtype": "int64", "shape": (1,), "names": None},
    }
    options = {"robot_type": "toy", "root": root, "recording": {"seed": 1}}
    with DatasetRecorder.create("t/t", 10, features, **options) as recorder:  # type: ignore[arg-type]
        for number, ending in enumerate(endings):
            writer = recorder.begin_episode()
            events = np.zeros(5, np.int64)
            events[-1] = ending
            writer.set_columns({"observation.state": np.full((5, 1), number, np.float32), "event": events})
            is_success = ending is Event.SUCCESS
            metadata = {"seed": number, "outcome": ending.cause, "success": is_success}
            recorder.save(writer, task="go", metadata=metadata)
    return root


def outcomes(root: Path) -> list[tuple[Any, Any]]:
    return [
        (episode.metadata.get("outcome"), episode.metadata.get("success")) for episode in dataset_info(root).episodes
    ]


def test_outcomes_and_marks_are_restored(tmp_path: Path) -> None:
    root = with_events(tmp_path / "d", [Event.SUCCESS, Event.TIMEOUT, Event.COLLISION])
    mark(root, [1], outcome="success")
    before = outcomes(root)
    assert before == [("success", True), ("success", True), ("collision", False)]
    shutil.rmtree(root / "meta/episodes")
    report = repair(root)
    assert outcomes(root) == before
    assert report.lost == ("meta/episodes: all columns bhd/… but outcome and success of episodes 0 to 2",)
    assert [edit["edit"] for edit in edits_of(root)] == ["mark", "recovered"]
    assert_valid(root)


def test_marks_are_restored_unless_episodes_were_renumbered(tmp_path: Path) -> None:
    origin = with_events(tmp_path / "origin", [Event.NOTHING] * 4)
    (origin / "meta/bhd.json").unlink()
    mark(origin, [0, 2], outcome="success")
    root = copied(origin, tmp_path / "numbered")
    shutil.rmtree(root / "meta/episodes")
    report = repair(root)
    assert outcomes(root) == [("success", True), (None, None), ("success", True), (None, None)]
    assert "gives the outcomes of episodes 0, 2" in str(report)
    delete(origin, [1])
    shutil.rmtree(origin / "meta/episodes")
    assert any("marked before episodes were renumbered" in one for one in repair(origin).lost)
    assert outcomes(origin) == [(None, None)] * 3


def test_files_that_cannot_be_read_now_are_not_given_up(recorded, tmp_path, monkeypatch):
    for is_ours in (True, False):
        root = copied(recorded, tmp_path / f"d{is_ours}")
        if not is_ours:
            (root / "meta/bhd.json").unlink()
        cut(500)(root / DATA)
        before = support.snapshot(root)

        def refuse(path: Path, *args: Any, **options: Any) -> Any:
            if Path(path).suffix == ".mp4":
                raise PermissionError(13, "Permission denied")
            return open(path, *args, **options)

        with monkeypatch.context() as patched:
            patched.setattr(guard, "open", refuse, raising=False)
            with pytest.raises(DatasetError, match=r"\.mp4 cannot be read: Permission denied.*Nothing was changed"):
                repair(root)
        assert support.snapshot(root) == before
        assert repair(root).episodes == 4


def test_a_damaged_identity_is_not_replaced(recorded: Path, tmp_path: Path) -> None:
    root = copied(recorded, tmp_path / "d")
    cut(500)(root / DATA)
    (root / "meta/bhd.json").write_text("{")
    before = support.snapshot(root)
    with pytest.raises(DatasetCorruptError, match=r"bhd\.json is corrupt"):
        repair(root)
    assert support.snapshot(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_leftovers_of_edits_and_recordings_are_distinguished(recorded: Path, tmp_path: Path) -> None:
    edited = copied(recorded, tmp_path / "edited")
    keep(recorded, [0], tmp_path / "half")
    shutil.move(tmp_path / "half", edited / ".bhd/compact/new")
    unfinished = tmp_path / "unfinished"
    support.killed(unfinished, 1)
    (unfinished / ".bhd/compact/new").mkdir(parents=True)
    for root, message in ((edited, "Repeat the edit"), (unfinished, "a recording was interrupted")):
        (found,) = [finding for finding in check_dataset(root).findings if finding.where == ".bhd"]
        assert message in f"{found.what}. {found.remedy}"
    repair(edited)
    assert content(edited) == content(recorded)


def test_a_damaged_value_costs_its_episode_only(recorded: Path, tmp_path: Path) -> None:
    """Pages have checksums: no value is taken that was not written."""
    groups = pq.read_metadata(recorded / DATA)
    expected = without_metadata(recorded)
    for group in (0, 2):
        root = copied(recorded, tmp_path / f"d{group}")
        bytes_ = bytearray((root / DATA).read_bytes())
        column = groups.row_group(group).column(0)
        bytes_[column.data_page_offset + column.total_compressed_size - 3] ^= 0xFF
        (root / DATA).write_bytes(bytes_)
        report = repair(root)
        assert report.episodes == 3
        assert any(f"row group {group} cannot be read" in line for line in report.lost)
        assert f"episode {group}: its frames are gone" in report.lost
        # The columns that number are counted anew; the others are theirs.
        kept = [one for number, one in enumerate(expected) if number != group]
        found = without_metadata(root)
        assert [one[0] for one in found] == [one[0] for one in kept]
        assert [one[1]["observation.state"] for one in found] == [one[1]["observation.state"] for one in kept]
        assert [one[2] for one in found] == [one[2] for one in kept]
        assert_valid(root)


def test_pages_that_are_damaged_cost_their_episodes_only(tmp_path: Path) -> None:
    root = tmp_path / "d"
    support.killed(root, 3)
    path = root / "data/chunk-000/file-001.parquet"
    path.write_bytes(path.read_bytes()[:100])
    report = repair(root)
    assert report.episodes == 2
    assert any("file-001.parquet" in line for line in report.lost)
    assert [episode.metadata["seed"] for episode in dataset_info(root).episodes] == [0, 2]
    table = pq.read_table(root / DATA)
    assert table["episode_index"].to_pylist() == [0] * support.length(0) + [1] * support.length(2)
    assert edits_of(root)[-1]["episodes"] == [0, 2]
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == 2
