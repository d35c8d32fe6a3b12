"""Merging, keeping, deleting and splitting: laws about what is in the result, whatever is killed or full."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.datasets.edit.edits import delete, edits_of, keep, merge, opened, split
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.summary import dataset_info, is_being_written
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.remote.local import open_local
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import (
    ConfigError,
    DatasetError,
    DatasetLockedError,
    DatasetMismatchError,
    DatasetWriteError,
    UnsupportedDatasetError,
)
from tests.datasets import support
from tests.datasets.edit_support import NUMBERS, assert_valid, content, record


@pytest.mark.parametrize("video", [False, True])
def test_merge_gives_all_episodes_in_order(tmp_path: Path, video: bool) -> None:
    parts = [record(tmp_path / f"d{i}", episodes, video=video) for i, episodes in enumerate([[3, 1], [0], [5, 4, 2]])]
    before = [content(part) for part in parts]
    report = merge(parts, tmp_path / "all")
    assert content(tmp_path / "all") == [episode for part in before for episode in part]
    assert [content(part) for part in parts] == before
    assert (report.episodes, report.frames) == (6, sum(support.length(e) for e in range(6)))
    assert_valid(tmp_path / "all")


def test_what_several_datasets_have_is_merged_once(six_episodes: Path, tmp_path: Path) -> None:
    """A part of another one, marked since, and what was recorded again: an episode is what was observed and done."""
    marked = Path(shutil.copytree(six_episodes, tmp_path / "marked"))
    mark(marked, [2], outcome="failure")
    keep(marked, [4, 2], tmp_path / "part")
    more = record(tmp_path / "more", [7, 1])
    report = merge([six_episodes, tmp_path / "part", more], tmp_path / "all")
    assert content(tmp_path / "all") == [*content(six_episodes), content(more)[0]]
    assert_valid(tmp_path / "all")
    assert report.left_out == {tmp_path / "part": [0, 1], more: [1]}
    assert f"left out: 2 episodes of {tmp_path / 'part'}, which a dataset before it has, too: 0, 1" in str(report)
    assert [one["episodes"] for one in edits_of(tmp_path / "all")[-1]["sources"]] == [6, 0, 1]


def test_episodes_that_only_look_alike_are_all_merged(tmp_path: Path) -> None:
    """With other words or another seed the same frames are another episode; of one without any motion nobody knows."""

    def recorded(name: str, *, task: str = "t", seed: int = 0, is_still: bool = False) -> Path:
        with support.create(tmp_path / name) as recorder:
            writer, columns = recorder.begin_episode(), support.columns(0)
            if is_still:
                columns["observation.state"][:] = 1.0
            writer.set_columns(columns)
            recorder.save(writer, task=task, metadata={**support.metadata(0), "seed": seed})
        return tmp_path / name

    pairs = [(recorded("a"), recorded("b", task="u")), (recorded("c"), recorded("d", seed=1))]
    pairs.append((recorded("e", is_still=True), recorded("f", is_still=True)))
    for number, pair in enumerate(pairs):
        assert merge(pair, tmp_path / str(number)).episodes == 2


def test_an_edited_dataset_is_not_continued(six_episodes: Path, tmp_path: Path) -> None:
    """Its next episode would not be the one of its seed."""
    keep(six_episodes, [0, 1], tmp_path / "kept")
    with pytest.raises(DatasetMismatchError, match=r"was edited after its recording \(.*another seed, and merge"):
        support.resume(tmp_path / "kept")


def test_filter_gives_the_wanted_episodes_in_the_wanted_order(
    six_episodes: Path, video_episodes: Path, tmp_path: Path
) -> None:
    cases = [
        (six_episodes, [0]),
        (six_episodes, [5, 2, 0]),
        (six_episodes, [0, 1, 2, 3, 4, 5]),
        (video_episodes, [2, 1]),
    ]
    for number, (source, wanted) in enumerate(cases):
        keep(source, wanted, tmp_path / str(number))
        whole = content(source)  # every pixel, too
        assert content(tmp_path / str(number)) == [whole[episode] for episode in wanted]
        assert_valid(tmp_path / str(number))
    with pytest.raises(ConfigError, match="Episode 1 is named twice"):
        keep(six_episodes, [1, 1], tmp_path / "twice")


@pytest.mark.law
def test_delete_leaves_the_others(six_episodes: Path, tmp_path: Path) -> None:
    root, left = shutil.copytree(six_episodes, tmp_path / "d"), content(six_episodes)
    for gone in ([5], [0], [1, 3]):
        delete(root, gone)
        left = [episode for index, episode in enumerate(left) if index not in gone]
        assert content(root) == left
        assert_valid(root)
        assert not (root / layout.STAGING).exists()
    with pytest.raises(DatasetError, match="No episode is left"):
        delete(root, range(len(left)))
    assert content(root) == left


def test_data_are_those_of_lerobots_own_merge(six_episodes: Path, tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    more = record(tmp_path / "more", [7, 8])
    theirs = merge_datasets(
        [LeRobotDataset("t/t", root=root) for root in (six_episodes, more)], "t/m", tmp_path / "theirs"
    )
    merge([six_episodes, more], tmp_path / "ours")
    name = "data/chunk-000/file-000.parquet"
    # Theirs forgets that lists have a fixed length, so values are compared.
    assert pq.read_table(tmp_path / "ours" / name).to_pydict() == pq.read_table(tmp_path / "theirs" / name).to_pydict()
    ours = LeRobotDataset("t/t", root=tmp_path / "ours")
    for key, stat in theirs.meta.stats.items():
        if key in NUMBERS:
            continue  # theirs are those of before the episodes were numbered anew
        for statistic, values in stat.items():
            assert ours.meta.stats[key][statistic] == pytest.approx(values), (key, statistic)


def test_unchanged_files_are_linked(tmp_path: Path) -> None:
    root = record(tmp_path / "d", [0, 1, 2], video=True)
    video = next(root.glob("videos/*/*/*.mp4"))
    before = video.stat().st_ino
    mark(root, [1], outcome="collision")
    assert next(root.glob("videos/*/*/*.mp4")).stat().st_ino == before
    assert content(root)[1].videos == content(record(tmp_path / "same", [0, 1, 2], video=True))[1].videos


def test_full_files_are_not_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the next one would not fit into a file another is begun, for data and for videos."""
    parts = [record(tmp_path / f"d{i}", [2 * i, 2 * i + 1], video=True) for i in range(3)]
    whole = [episode for part in parts for episode in content(part)]
    for kind, megabytes in (("data", layout.DATA_FILES_SIZE_IN_MB), ("videos", layout.VIDEO_FILES_SIZE_IN_MB)):
        size = max(path.stat().st_size for part in parts for path in (part / kind).rglob("file-*"))
        monkeypatch.setattr("bhd_lerobot.datasets.assembly.files.MEBIBYTE", 1.5 * size / megabytes)
        merge(parts, tmp_path / kind)
        assert len(list((tmp_path / kind / kind).rglob("file-*"))) == 3
        assert content(tmp_path / kind) == whole
        assert_valid(tmp_path / kind)


def test_edits_are_logged(tmp_path: Path) -> None:
    roots = [record(tmp_path / name, episodes) for name, episodes in (("a", [0, 1]), ("b", [2, 3]))]
    merge(roots, tmp_path / "all")
    delete(tmp_path / "all", [2])
    keep(tmp_path / "all", [1], tmp_path / "one")
    assert [edit["edit"] for edit in edits_of(tmp_path / "one")] == ["merge", "delete", "keep"]
    assert edits_of(tmp_path / "one")[1]["episodes"] == [2]
    assert edits_of(roots[0]) == []


def test_episodes_of_another_shape_do_not_merge(six_episodes: Path, tmp_path: Path) -> None:
    features = {
        **support.FEATURES,
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
    }
    recorder = DatasetRecorder.create("t/t", 20, features, robot_type="toy", root=tmp_path / "other")
    writer = recorder.begin_episode()
    writer.set_columns({**support.columns(0), "observation.state": support.columns(0)["observation.state"][:, :2]})
    recorder.save(writer, task="t", metadata={})
    recorder.finalize()
    with pytest.raises(DatasetMismatchError) as error:
        merge([six_episodes, tmp_path / "other"], tmp_path / "all")
    assert "observation.state.shape" in str(error.value)
    assert "fps: there 10, here 20" in str(error.value)
    assert not (tmp_path / "all").exists()


def test_recordings_in_other_units_do_not_merge(six_episodes: Path, tmp_path: Path) -> None:
    def recorded(name: str, **options: object) -> Path:
        root = Path(shutil.copytree(six_episodes, tmp_path / name))
        path = root / layout.IDENTITY
        identity = json.loads(path.read_text())
        identity["recording"]["robot"] = {"type": "mock_arm", **options}
        path.write_text(json.dumps(identity))
        return root

    first, same = recorded("a", use_degrees=True, log="x"), recorded("b", use_degrees=True, log="y")
    with pytest.raises(DatasetMismatchError, match=r"robot.use_degrees = true and .*c with false"):
        merge([first, same, recorded("c", use_degrees=False)], tmp_path / "wrong")
    assert not (tmp_path / "wrong").exists()
    merge([first, same], tmp_path / "all")
    assert_valid(tmp_path / "all")


def test_metadata_of_some_episodes_is_empty_in_the_others_and_of_another_type_does_not_merge(six_episodes, tmp_path):
    for name, metadata in (("other", {"outcome": "stuck", "extra": 3}), ("odd", {"outcome": 3})):
        recorder = support.create(tmp_path / name)
        recorder.save(support.fill(recorder.begin_episode(), 1), task="t", metadata=metadata)
        recorder.finalize()
    merge([six_episodes, tmp_path / "other"], tmp_path / "all")
    episodes = dataset_info(tmp_path / "all").episodes
    assert episodes[0].metadata == support.metadata(0)
    assert episodes[-1].metadata == {"outcome": "stuck", "extra": 3}
    with pytest.raises(DatasetMismatchError, match="bhd/outcome"):
        merge([six_episodes, tmp_path / "odd"], tmp_path / "none")


def test_several_read_a_dataset_at_once_and_nobody_writes_it_meanwhile(six_episodes: Path, tmp_path: Path) -> None:
    root, other = Path(shutil.copytree(six_episodes, tmp_path / "d")), record(tmp_path / "other", [7])
    with opened([root]):
        keep(root, [0], tmp_path / "kept")
        merge([root, other], tmp_path / "all")
        with open_local(root):
            assert not is_being_written(root)
        for write in (lambda: delete(root, [0]), lambda: support.resume(root), lambda: repair(root)):
            with pytest.raises(DatasetLockedError, match="edited or copied by another process"):
                write()
    delete(root, [0])
    assert content(root) == content(six_episodes)[1:]


def test_a_dataset_that_is_being_recorded_is_refused(tmp_path: Path) -> None:
    root = record(tmp_path / "d", [0, 1])
    lock = RootLock(root)
    with pytest.raises(DatasetLockedError):
        delete(root, [0])
    lock.release()
    support.killed(tmp_path / "open", 1)
    with pytest.raises(DatasetError, match="bhd-data repair"):
        merge([root, tmp_path / "open"], tmp_path / "all")


def test_a_file_system_without_locks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    root = record(tmp_path / "d", [0, 1])
    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(DatasetWriteError, match=f"{root} cannot be locked: No locks available"):
        delete(root, [0])


def stock(root: Path) -> Path:
    """Let a dataset be another program's, with a column of its own and files beside."""
    (root / "meta/bhd.json").unlink()
    path = next(root.glob("meta/episodes/*/*.parquet"))
    table = pq.read_table(path)
    names = [f"person {index}" for index in range(table.num_rows)]
    pq.write_table(table.append_column("operator", pa.array(names)), path)
    (root / "meta/subtasks.json").write_text("{}")
    (root / "data/NOTES.txt").write_text("notes")
    return root


def operators(root: Path) -> list[str]:
    return pq.read_table(next(root.glob("meta/episodes/*/*.parquet")))["operator"].to_pylist()


def test_columns_and_files_of_other_programs_are_kept(six_episodes: Path, tmp_path: Path) -> None:
    root = stock(shutil.copytree(six_episodes, tmp_path / "d"))
    keep(root, [4, 1], tmp_path / "kept")
    assert operators(tmp_path / "kept") == ["person 4", "person 1"]
    assert (tmp_path / "kept/meta/subtasks.json").exists()
    merge([tmp_path / "kept", six_episodes], tmp_path / "all")
    assert operators(tmp_path / "all") == ["person 4", "person 1"] + [None] * 4
    before = [one.columns for one in content(root)]
    mark(root, [0], outcome="failure")
    assert operators(root) == [f"person {index}" for index in range(6)]
    assert (root / "data/NOTES.txt").read_text() == "notes"
    assert [one.columns for one in content(root)] == before  # what its columns mean, we do not know
    (root / "meta/stats.json").unlink()
    assert fix(root, check_dataset(root).findings)
    assert operators(root) == [f"person {index}" for index in range(6)]


def test_deviations_that_cannot_be_those_of_the_data_are_computed_from_the_new_content(
    six_episodes: Path, tmp_path: Path
) -> None:
    """Another program rounds them to nothing; also those of columns that an edit writes anew."""
    for name, edit in (
        ("deleted", lambda root: delete(root, [0])),
        ("marked", lambda root: mark(root, [1], outcome="failure")),
    ):
        root = Path(shutil.copytree(six_episodes, tmp_path / name))
        (path,) = (root / "meta/episodes").rglob("*.parquet")
        table = pq.read_table(path)
        for key in ("index", "event", "observation.state"):
            place, width = table.schema.get_field_index(f"stats/{key}/std"), 3 if key == "observation.state" else 1
            zeros = pa.array([[0.0] * width] * len(table), table.schema.types[place])
            table = table.set_column(place, table.schema.field(place), zeros)
        pq.write_table(table, path)
        edit(root)
        assert not [finding for finding in check_dataset(root).findings if finding.check == "stats"], name


def test_datasets_share_no_file(six_episodes: Path, video_episodes: Path, tmp_path: Path) -> None:
    """Other programs write into files; what happens to one dataset must not happen to another."""
    for number, source in enumerate((six_episodes, video_episodes)):
        keep(source, range(3), tmp_path / f"k{number}")
        split(source, {"all": range(3)}, tmp_path / f"s{number}")
        for path in tmp_path.rglob("*"):
            assert path.is_dir() or path.stat().st_nlink == 1, path


def test_links_of_a_cache_are_followed(video_episodes: Path, tmp_path: Path) -> None:
    """The Hub's client keeps datasets as relative links."""
    cache = tmp_path / "datasets--me--d"
    (cache / "blobs").mkdir(parents=True)
    snapshot = cache / "snapshots" / "abc"
    for number, path in enumerate(one for one in sorted(video_episodes.rglob("*")) if one.is_file()):
        blob, link = cache / "blobs" / str(number), snapshot / path.relative_to(video_episodes)
        shutil.copy(path, blob)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blob, link.parent))
    keep(snapshot, range(3), tmp_path / "kept")
    assert content(tmp_path / "kept") == content(video_episodes)
    mark(snapshot, [0], outcome="stuck")
    assert content(snapshot)[1:] == content(video_episodes)[1:]


def test_instructions_of_an_episode_that_has_several(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {"action": {"dtype": "float32", "shape": (1,), "names": ["a"]}}
    dataset = LeRobotDataset.create("t/t", fps=10, features=features, root=tmp_path / "d", use_videos=False)
    for episode in range(3):
        for frame in range(4):
            dataset.add_frame({"action": np.array([episode], np.float32), "task": f"{episode}" if frame < 2 else "end"})
        dataset.save_episode()
    dataset.finalize()
    keep(tmp_path / "d", [2, 1], tmp_path / "kept")
    assert [set(one.task) for one in content(tmp_path / "kept")] == [{"2", "end"}, {"1", "end"}]
    assert_valid(tmp_path / "kept")
    loaded = LeRobotDataset("t/t", root=tmp_path / "kept")
    assert [loaded[index]["task"] for index in (0, 3, 4, 7)] == ["2", "end", "1", "end"]


def test_depth_of_another_scale_does_not_merge(video_episodes: Path, tmp_path: Path) -> None:
    other = shutil.copytree(video_episodes, tmp_path / "other")
    info = json.loads((other / "meta/info.json").read_text())
    info["features"][support.CAMERA]["info"]["video.depth_max"] = 3.0
    (other / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DatasetMismatchError, match=r"depth_max: not"):
        merge([video_episodes, other], tmp_path / "all")


def test_files_at_other_places_are_refused_by_name(six_episodes: Path, tmp_path: Path) -> None:
    root = shutil.copytree(six_episodes, tmp_path / "d")
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "data_path": "frames/{episode_index}.parquet"}))
    with pytest.raises(UnsupportedDatasetError, match=r"frames/\{episode_index\}"):
        delete(root, [0])
