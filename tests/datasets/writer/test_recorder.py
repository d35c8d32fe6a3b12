"""What the recorder writes is what LeRobot's own writer writes for the same frames, and what goes in comes out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.storage.places import wrong_name
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetError, FrameError
from tests.cases import each_case
from tests.datasets import support

CAMERA = support.CAMERA
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (7,), "names": list("abcdefg")},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "control.age": {"dtype": "float64", "shape": (1,), "names": None},
    "control.mode": {"dtype": "int64", "shape": (1,), "names": None},
    "control.pair": {"dtype": "int64", "shape": (2,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "flags": {"dtype": "bool", "shape": (3,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
    CAMERA: {"dtype": "video", "shape": (32, 48, 3), "names": ["height", "width", "channels"]},
}
LENGTHS = (30, 1, 12)


def frames(episode: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(episode)
    return [
        {
            "observation.state": rng.normal(5, 2, 7).astype(np.float32),
            "action": rng.normal(size=2).astype(np.float32),
            "control.age": rng.random(1),
            "control.mode": rng.integers(0, 5, 1),
            "control.pair": rng.integers(-9, 9, 2),
            "next.done": rng.random(1) < 0.3,
            "flags": rng.random(3) < 0.5,
            "note": f"{episode}:{frame}",
            CAMERA: np.full((32, 48, 3), (10 * episode + 3 * frame, 40, 200), np.uint8),
        }
        for frame in range(LENGTHS[episode])
    ]


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same episodes, recorded by LeRobot and by us."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = tmp_path_factory.mktemp("both")
    theirs, ours = folder / "theirs", folder / "ours"
    # LeRobot cannot join files with B-frames when an episode is a single frame.
    extra = {"bf": 0, "mbtree": 0}
    encoder = RGBEncoderConfig(vcodec="h264", crf=23, preset="veryfast", extra_options=extra)
    video = VideoSettings(extra_options=extra)
    dataset = LeRobotDataset.create(
        "t/theirs", 10, json.loads(json.dumps(FEATURES)) | FEATURES, root=theirs, robot_type="toy", rgb_encoder=encoder
    )
    with DatasetRecorder.create("t/ours", 10, FEATURES, robot_type="toy", root=ours, video=video) as recorder:
        for episode in range(len(LENGTHS)):
            writer = recorder.begin_episode()
            for frame in frames(episode):
                dataset.add_frame({**frame, "task": support.task(episode)})
                writer.add_image(CAMERA, frame.pop(CAMERA))
                writer.add_frame(frame)
            dataset.save_episode()
            recorder.save(writer, task=support.task(episode), metadata={"seed": episode})
        dataset.finalize()
    return theirs, ours


@pytest.mark.law
def test_data_equals_lerobots(roots: tuple[Path, Path]) -> None:
    theirs, ours = (pq.read_table(root / "data/chunk-000/file-000.parquet") for root in roots)
    assert theirs.equals(ours)
    assert theirs.schema.remove_metadata() == ours.schema.remove_metadata()
    notes = [json.loads(table.schema.metadata[b"huggingface"])["info"] for table in (theirs, ours)]
    assert notes[0] == notes[1]
    file = pq.ParquetFile(roots[1] / "data/chunk-000/file-000.parquet")
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == list(LENGTHS)


def test_info_equals_lerobots(roots: tuple[Path, Path]) -> None:
    theirs, ours = (json.loads((root / "meta/info.json").read_text()) for root in roots)
    assert theirs == ours
    assert list(theirs["features"]) == list(ours["features"])
    tasks = [pq.read_table(root / "meta/tasks.parquet").to_pandas() for root in roots]
    assert tasks[0].equals(tasks[1])
    assert tasks[0].index.name == tasks[1].index.name


def test_episodes_equal_lerobots(roots: tuple[Path, Path]) -> None:
    theirs, ours = (pq.read_table(root / "meta/episodes") for root in roots)
    assert set(theirs.column_names) == {name for name in ours.column_names if not name.startswith("bhd/")}
    assert ours["bhd/seed"].to_pylist() == [0, 1, 2]
    for name in theirs.column_names:
        assert theirs.schema.field(name).type == ours.schema.field(name).type, name
        a, b = theirs[name].to_pylist(), ours[name].to_pylist()
        if not name.startswith("stats/"):
            if name.endswith("_timestamp"):
                np.testing.assert_allclose(a, b, atol=1e-9)
            else:
                assert a == b, name
            continue
        feature = name.removeprefix("stats/").rsplit("/", 1)[0]
        for episode, (x, y) in enumerate(zip(a, b, strict=True)):
            spread = np.subtract(
                ours[f"stats/{feature}/max"][episode].as_py(), ours[f"stats/{feature}/min"][episode].as_py()
            )
            # LeRobot's quantiles come from 5000 bins over the range, its deviations from float32 sums.
            tolerance = 2e-5 * np.abs(np.asarray(y)).max() + spread.max() / 4000 + 1e-6
            if name.endswith("/std"):
                tolerance += 2e-3 * max(1.0, np.abs(np.asarray(ours[f"stats/{feature}/mean"][episode].as_py())).max())
            np.testing.assert_allclose(x, y, rtol=0, atol=tolerance, err_msg=f"{name} of episode {episode}")


def test_statistics_of_the_whole_are_lerobots(roots: tuple[Path, Path]) -> None:
    theirs, ours = (json.loads((root / "meta/stats.json").read_text()) for root in roots)
    assert theirs.keys() == ours.keys()
    for key, stats in theirs.items():
        assert stats.keys() == ours[key].keys()
        for name in ("min", "max", "mean", "count"):
            np.testing.assert_allclose(ours[key][name], stats[name], rtol=1e-4, atol=1e-4, err_msg=f"{key} {name}")


def _feature(dtype: str, size: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (1 if dtype == "string" else size,), "names": None}


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_round_trip_of_random_features(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    dtypes = st.sampled_from(["float32", "float64", "int64", "bool", "string"])
    names = st.text(st.characters(exclude_characters="/\\", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8)
    names = names.filter(lambda name: not wrong_name(name))
    chosen = data.draw(st.dictionaries(names, st.builds(_feature, dtypes, st.integers(1, 5)), min_size=1, max_size=5))
    lengths = data.draw(st.lists(st.integers(1, 8), min_size=1, max_size=4))
    by_frame = data.draw(st.booleans())
    values = {
        "float32": st.floats(width=32, allow_nan=False, allow_infinity=False),
        "float64": st.floats(allow_nan=False, allow_infinity=False, min_value=-1e150, max_value=1e150),
        "int64": st.integers(-(2**63), 2**63 - 1),
        "bool": st.booleans(),
        "string": st.text(st.characters(exclude_categories=["Cs"]), max_size=5),
    }
    root = tmp_path_factory.mktemp("round") / "dataset"
    written: dict[str, list[Any]] = {key: [] for key in chosen}
    with DatasetRecorder.create("t/t", 30, chosen, robot_type="toy", root=root) as recorder:
        for length in lengths:
            columns = {}
            for key, feature in chosen.items():
                size = feature["shape"][0]
                rows = data.draw(
                    st.lists(
                        st.lists(values[feature["dtype"]], min_size=size, max_size=size),
                        min_size=length,
                        max_size=length,
                    )
                )
                dtype = object if feature["dtype"] == "string" else feature["dtype"]
                columns[key] = np.array(rows, dtype=dtype)
                written[key] += [row[0] if size == 1 else row for row in columns[key].tolist()]
            writer = recorder.begin_episode()
            if by_frame:
                for i in range(length):
                    writer.add_frame({key: column[i] for key, column in columns.items()})
            else:
                writer.set_columns(columns)
            recorder.save(writer, task="t", metadata={})
        assert recorder.num_frames == sum(lengths)
    table = pq.read_table(root / "data/chunk-000/file-000.parquet")
    for key in chosen:
        assert table[key].to_pylist() == written[key]
    assert table["timestamp"].to_pylist() == [np.float32(i / 30) for length in lengths for i in range(length)]


def test_episodes_may_be_open_side_by_side(tmp_path: Path) -> None:
    """As with parallel simulations: indices are given in the order of saving, discarded episodes leave nothing."""
    root = tmp_path / "dataset"
    with support.create(root, video=True) as recorder:
        writers = [recorder.begin_episode() for _ in range(4)]
        for episode in (2, 0, 1):
            support.fill(writers[episode], episode, video=True)
        writers[3].add_image(CAMERA, np.zeros((32, 48, 3), np.uint8))
        writers[3].discard()
        writers[3].discard()
        for episode in range(3):
            assert (
                recorder.save(writers[episode], task=support.task(episode), metadata=support.metadata(episode))
                == episode
            )
        left_open = recorder.begin_episode()
        left_open.add_image(CAMERA, np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(FrameError, match="saved or discarded"):
        left_open.add_image(CAMERA, np.zeros((32, 48, 3), np.uint8))
    assert support.verify(root, 3, video=True, stats=True) == 3
    assert not (root / ".bhd").exists()


def test_values_are_copied(tmp_path: Path) -> None:
    with DatasetRecorder.create(
        "t/t", 10, {"x": {"dtype": "float32", "shape": (2,), "names": None}}, robot_type="toy", root=tmp_path / "d"
    ) as recorder:
        value = np.zeros(2, np.float32)
        writer = recorder.begin_episode()
        for i in range(200):
            value[:] = i
            writer.add_frame({"x": value})
        assert writer.length == 200
        recorder.save(writer, task="t", metadata={})
        columns = {"x": np.ones((3, 2), np.float32)}
        writer = recorder.begin_episode()
        writer.set_columns(columns)
        columns["x"][:] = 7
        recorder.save(writer, task="t", metadata={})
    stored = pq.read_table(tmp_path / "d/data/chunk-000/file-000.parquet")["x"].to_pylist()
    assert stored == [[i, i] for i in range(200)] + [[1, 1]] * 3


def test_resuming_appends_and_touches_full_files_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bhd_lerobot.datasets.storage import layout

    # Limits of a few kilobytes, so that every file is full soon.
    monkeypatch.setattr(layout, "DATA_FILES_SIZE_IN_MB", 0.012)
    monkeypatch.setattr(layout, "VIDEO_FILES_SIZE_IN_MB", 0.012)
    monkeypatch.setattr(layout, "CHUNKS_SIZE", 3)
    root = tmp_path / "dataset"
    with support.create(root, video=True) as recorder:
        for _ in range(12):
            support.record(recorder, video=True)
    files = {path: path.stat().st_ino for path in root.rglob("file-*.*")}
    assert support.verify(root, 12, video=True, stats=True) == 12
    data = sorted((root / "data").rglob("*.parquet"))
    assert len(data) > 3, "the limit makes several files, in several chunks"
    assert all(path.stat().st_size < 0.02 * 1024**2 for path in data)
    for _ in range(2):
        with support.resume(root, video=True) as recorder:
            support.record(recorder, video=True)
    assert support.verify(root, 14, video=True, stats=True) == 14
    kept = [path for path, inode in files.items() if path.exists() and path.stat().st_ino == inode]
    assert len([path for path in kept if path.suffix == ".parquet" and "data" in path.parts]) >= len(data) - 1
    with support.resume(root, video=True):
        pass
    assert support.verify(root, 14, video=True, stats=True) == 14


@pytest.mark.parametrize("megabytes", [0.03, 0.06])
def test_what_is_merged_is_merged_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, megabytes: float) -> None:
    """Files become smaller when they are merged; two that would fit into one afterwards stay two."""
    from bhd_lerobot.datasets.storage import layout

    monkeypatch.setattr(layout, "DATA_FILES_SIZE_IN_MB", megabytes)
    root = tmp_path / "dataset"
    with support.create(root) as recorder:
        for _ in range(30):
            support.record(recorder)
    assert len(list((root / "data").rglob("*.parquet"))) > 1
    assert not repair(root)
    with support.resume(root):
        pass
    assert not repair(root)
    assert support.read_back(root) == 30


@pytest.mark.parametrize("lacking", ["/q", f"stats/{support.CAMERA}"])
def test_statistics_that_another_program_did_not_store_are_computed_or_left_out(tmp_path: Path, lacking: str) -> None:
    """Older versions of LeRobot know no quantiles; those of images only decoding would tell."""
    for name in ("whole", "lacking"):
        root = tmp_path / name
        with support.create(root, video=True) as recorder:
            for _ in range(3):
                support.record(recorder, video=True)
        if name == "lacking":
            (path,) = (root / "meta/episodes").rglob("*.parquet")
            table = pq.read_table(path)
            gone = [column for column in table.column_names if column.startswith("stats/") and lacking in column]
            assert gone
            pq.write_table(table.drop_columns(gone), path)
        with support.resume(root, video=True) as recorder:
            support.record(recorder, video=True)
    whole, other = (json.loads((tmp_path / name / "meta/stats.json").read_text()) for name in ("whole", "lacking"))
    for key, stat in whole.items():
        if key != support.CAMERA:
            assert other[key] == stat, key
        elif lacking == "/q":
            assert other[key] == {name: values for name, values in stat.items() if not name.startswith("q")}
        else:
            assert key not in other


def test_stock_lerobot_can_append_and_we_can_go_on(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "dataset"
    features = {"x": {"dtype": "float32", "shape": (2,), "names": None}}
    with DatasetRecorder.create("t/t", 10, features, robot_type="toy", root=root) as recorder:
        writer = recorder.begin_episode()
        writer.set_columns({"x": np.zeros((4, 2), np.float32)})
        recorder.save(writer, task="ours", metadata={"seed": 1})
    dataset = LeRobotDataset.resume("t/t", root=root)
    for _ in range(3):
        dataset.add_frame({"x": np.ones(2, np.float32), "task": "theirs"})
    dataset.save_episode()
    dataset.finalize()
    with DatasetRecorder.resume("t/t", 10, features, robot_type="toy", root=root) as recorder:
        assert recorder.num_episodes == 2
        writer = recorder.begin_episode()
        writer.set_columns({"x": np.full((2, 2), 2, np.float32)})
        recorder.save(writer, task="theirs", metadata={"seed": 2})
    dataset = LeRobotDataset("t/t", root=root, video_backend="pyav")
    assert [dataset[i]["x"][0].item() for i in range(9)] == [0, 0, 0, 0, 1, 1, 1, 2, 2]
    assert [dataset[i]["task"] for i in (0, 4, 8)] == ["ours", "theirs", "theirs"]


FRAME = {"observation.state": np.zeros(3, np.float32), "event": 1, "next.done": False, "note": "x"}


def test_bad_frames_are_refused_and_leave_no_trace(tmp_path: Path) -> None:
    changes: tuple[tuple[dict[str, Any], str], ...] = (
        ({"event": None}, "missing: event"),
        ({"even": 1}, "not a feature: even"),
        ({"event": 1.5}, "cannot be stored"),
        ({"event": [1, 2]}, "needs the shape"),
        ({"next.done": 1}, "cannot be stored"),
        ({"note": 3}, "holds text"),
        ({"observation.state": np.zeros(4, np.float32)}, r"shape \(3,\); got \(4,\)"),
    )
    with support.create(tmp_path / "d") as recorder:
        writer = recorder.begin_episode()
        for change, message in changes:
            with pytest.raises(FrameError, match=message):
                writer.add_frame({key: value for key, value in {**FRAME, **change}.items() if value is not None})
            assert writer.length == 0
        writer.add_frame(FRAME)
        assert recorder.save(writer, task="t", metadata={}) == 0


def test_bad_episodes_are_refused_and_stay_open(tmp_path: Path) -> None:
    with support.create(tmp_path / "d", video=True) as recorder:
        writer = recorder.begin_episode()
        with pytest.raises(FrameError, match="no frames"):
            recorder.save(writer, task="t", metadata={})
        with pytest.raises(FrameError, match="must be uint8"):
            writer.add_image(CAMERA, np.zeros((32, 48, 3), np.float32))
        with pytest.raises(FrameError, match="Did you mean"):
            writer.add_image(CAMERA + "s", np.zeros((32, 48, 3), np.uint8))
        columns = support.columns(0)
        with pytest.raises(FrameError, match="event"):
            writer.set_columns({**columns, "event": columns["event"][:2]})
        del columns["event"]
        writer.set_columns(columns)
        with pytest.raises(FrameError, match="no values for event"):
            recorder.save(writer, task="t", metadata={})
        writer.set_columns({"event": support.columns(0)["event"]})
        with pytest.raises(FrameError, match="0 images for 5 frames"):
            recorder.save(writer, task="t", metadata={})
        with pytest.raises(FrameError, match="not with both"):
            writer.add_frame(FRAME)
        for frame in range(5):
            writer.add_image(CAMERA, np.full((32, 48, 3), support.grey(0, frame), np.uint8))
        with pytest.raises(FrameError, match="sentence"):
            recorder.save(writer, task="", metadata={})
        with pytest.raises(FrameError, match="metadata 'x'"):
            recorder.save(writer, task="t", metadata={"x": None})
        recorder.save(writer, task=support.task(0), metadata=support.metadata(0))
        with pytest.raises(FrameError, match="not an open one"):
            recorder.save(writer, task="t", metadata={})
        writer = support.fill(recorder.begin_episode(), 1, video=True)
        rest = {key: value for key, value in support.metadata(1).items() if key != "seed"}
        with pytest.raises(FrameError, match=r"Missing: \['seed'\]"):
            recorder.save(writer, task="t", metadata=rest)
        broken = recorder.begin_episode()
        broken.set_columns({**support.columns(0), "observation.state": np.full((5, 3), np.nan, np.float32)})
        broken.add_video(CAMERA, b"", np.zeros((5, 3, 256), np.uint32))
        with pytest.raises(FrameError, match=r"'observation.state' holds nan at position 0 of frame 0"):
            recorder.save(broken, task="t", metadata=support.metadata(1))
        broken.discard()
        with pytest.raises(FrameError, match="was int64"):
            recorder.save(writer, task="t", metadata={**support.metadata(1), "seed": 1.5})
        recorder.save(writer, task=support.task(1), metadata={**support.metadata(1), "score": np.float64(0.25)})
    with pytest.raises(DatasetError, match="finalised"):
        recorder.begin_episode()
    recorder.finalize()
    assert support.verify(tmp_path / "d", 2, video=True, stats=True) == 2


@each_case(
    ("features", "words"),
    [
        ({}, "at least one"),
        ({"a/b": {"dtype": "float32", "shape": (1,)}}, "'/'"),
        ({"a": {"dtype": "float23", "shape": (1,)}}, "Did you mean 'float32'"),
        ({"a": {"dtype": "float32", "shape": (2, 2)}}, "Flatten"),
        ({"a": {"dtype": "float32", "shape": 3}}, "list of sizes"),
        ({"a": {"dtype": "float32", "shape": (2,), "names": ["x"]}}, "1 names for 2"),
        ({"a": {"dtype": "video", "shape": (3, 32, 48)}}, "height, width, 3"),
        ({"a": {"dtype": "video", "shape": (31, 48, 3)}}, "even"),
        ({"said": {"dtype": "language", "shape": (1,)}}, "is for 'language_persistent' and for nothing else"),
        ({"language_persistent": {"dtype": "string", "shape": (1,)}}, "is for 'language_persistent' and for"),
    ],
)
def test_bad_features_are_refused(tmp_path: Path, features: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        DatasetRecorder.create("t/t", 10, features, robot_type="toy", root=tmp_path / "d")
    assert not any(tmp_path.iterdir())


def test_bad_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="h264"):
        DatasetRecorder.create(
            "t/t", 10, support.VIDEO_FEATURES, robot_type="t", root=tmp_path / "e", video=VideoSettings(vcodec="h265x")
        )
    with pytest.raises(ConfigError, match="fps"):
        DatasetRecorder.create("t/t", 0, support.FEATURES, robot_type="t", root=tmp_path / "e")
    with pytest.raises(ConfigError, match="JSON"):
        DatasetRecorder.create("t/t", 1, support.FEATURES, robot_type="t", root=tmp_path / "e", recording={"x": {1}})


def test_language_rows_are_lerobots_and_bad_ones_are_refused(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": None},
        "language_persistent": {"dtype": "language", "shape": (1,), "names": None},
    }
    row = {"role": "assistant", "style": "subtask", "timestamp": 0.0, "camera": None, "tool_calls": None}
    first, second = ({**row, "content": text} for text in ("one", "两"))
    root = tmp_path / "d"
    with DatasetRecorder.create("test/said", 10, features, root=root, robot_type="r") as recorder:
        for rows in ([[], [first]], [[first, second]] * 3):
            writer = recorder.begin_episode()
            writer.set_columns(
                {"action": np.zeros((len(rows), 2), np.float32), "language_persistent": np.array(rows, dtype=object)}
                if rows[0] == []
                else {"action": np.zeros((3, 2), np.float32), "language_persistent": rows}
            )
            recorder.save(writer, task="t", metadata={})
        writer = recorder.begin_episode()
        writer.set_columns({"action": np.zeros((1, 2), np.float32), "language_persistent": [[{"content": "no"}]]})
        with pytest.raises(FrameError, match="role, content, style"):
            recorder.save(writer, task="t", metadata={})
        writer.discard()
        recorder.finalize()
    dataset = LeRobotDataset("test/said", root=root, video_backend="pyav")
    assert [one["content"] for one in dataset[4]["language_persistent"]] == ["one", "两"]
    assert dataset[0]["language_persistent"] == []


@each_case(("dropped", "video"), [((0,), True), ((1,), False), ((0, 1, 2), False), ((3,), True)])
def test_the_last_save_may_be_taken_back(tmp_path: Path, dropped: tuple[int, ...], video: bool) -> None:
    """As if it had never been: what is recorded afterwards gives the dataset of a recording without it."""
    roots = tmp_path / "plain", tmp_path / "taken_back"
    for root, taken_back in zip(roots, ((), dropped), strict=True):
        with support.create(root, video=video) as recorder:
            for episode in range(4):
                if episode in taken_back:
                    writer = support.fill(recorder.begin_episode(), 7, video=video)  # another episode and another task
                    recorder.save(writer, task="another task", metadata=support.metadata(7))
                    recorder.drop_last()
                    assert recorder.num_episodes == episode
                    with pytest.raises(DatasetError, match="no episode of this recording that can be taken back"):
                        recorder.drop_last()
                support.record(recorder, video=video)
        assert check_dataset(root).is_valid
    first, second = (sorted(path.relative_to(root) for path in root.rglob("*") if path.is_file()) for root in roots)
    assert first == second
    for path in first:
        read = json.loads if path.suffix == ".json" else bytes
        assert read((roots[0] / path).read_bytes()) == read((roots[1] / path).read_bytes()), path
