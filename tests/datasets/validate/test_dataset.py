"""A valid dataset has no finding; each kind of damage has one, which names the place."""

import re
import shutil
from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.datasets.validate.dataset import CHECKS, DatasetCheck, Finding, Severity, check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from tests.cases import each_case
from tests.datasets.foreign import edit, edit_json
from tests.datasets.loader import support as loader_support
from tests.datasets.support import snapshot

FPS, EPISODES, CAMERA = 10, 6, "observation.images.front"
STATE = ["a.pos", "b.pos", "tool_qw.pos", "tool_qx.pos", "tool_qy.pos", "tool_qz.pos"]
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (6,), "names": STATE},
    "action": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "grip.pos"]},
    "control.late": {"dtype": "bool", "shape": (1,), "names": None},
    "control.age": {"dtype": "float32", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
}
VIDEO = {CAMERA: {"dtype": "video", "shape": (32, 48, 3), "names": ["height", "width", "channels"]}}


def limits(robot_type: str | None) -> dict[str, dict[str, tuple[float, float]]]:
    assert robot_type == "toy"
    return {"observation.state": {"a.pos": (-2.0, 2.0), "nothing.pos": (0.0, 1.0)}}


def length(episode: int) -> int:
    return 20 + episode


def columns(episode: int) -> dict[str, np.ndarray]:
    """An arm that turns its tool by a third of a turn, and closes its gripper once."""
    rng = np.random.default_rng(episode)
    time = np.arange(length(episode)) / FPS
    half = 0.5 * (time + episode)
    quaternion = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    quaternion *= np.sign(quaternion @ [0.6, 0.8, 0, 0])[:1, None]
    position = np.stack([np.sin(time + episode), np.cos(time)], axis=1) + rng.normal(0, 0.01, (len(time), 2))
    return {
        "observation.state": np.concatenate([position, quaternion], axis=1).astype(np.float32),
        "action": np.stack([np.sin(time + episode + 0.1), time > 1.0], axis=1).astype(np.float32),
        "control.late": np.zeros(len(time), np.bool_),
        "control.age": rng.uniform(0, 0.01, len(time)).astype(np.float32),
        "note": np.array([f"{frame}" for frame in range(len(time))], object),
    }


def record(root: Path, *, finalize: bool = True, video: bool = False, outcome: str = "success") -> Path:
    features = {**FEATURES, **(VIDEO if video else {})}
    recorder = DatasetRecorder.create("t/t", FPS, features, robot_type="toy", root=root, recording={"seed": 1})
    for episode in range(EPISODES):
        writer = recorder.begin_episode()
        writer.set_columns(columns(episode))
        if video:
            for frame in range(length(episode)):
                writer.add_image(CAMERA, np.full((32, 48, 3), 20 + 5 * frame, np.uint8))
        recorder.save(writer, task=f"task {episode % 2}", metadata={"outcome": outcome})
    if finalize:
        recorder.finalize()
    return root


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("check") / "d")


@pytest.fixture(scope="module")
def video_dataset(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("check") / "v", video=True)


def copy(root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(root, tmp_path / "copy"))


def data_file(root: Path) -> Path:
    return next((root / "data").rglob("*.parquet"))


def bad(found: DatasetCheck) -> list[Finding]:
    return [finding for finding in found.findings if finding.severity > Severity.NOTE]


@pytest.mark.law
def test_a_valid_dataset_has_no_finding_and_is_not_changed(valid: Path) -> None:
    before = snapshot(valid)
    found = check_dataset(valid, limits)
    assert bad(found) == []
    assert (found.episodes, found.frames) == (EPISODES, sum(map(length, range(EPISODES))))
    assert [finding.what for finding in found.findings if finding.check == "outcome"] == ["success 6"]
    assert snapshot(valid) == before


def test_a_dataset_of_stock_lerobot_is_valid(stock: Path) -> None:
    assert [finding for finding in check_dataset(stock).findings if finding.severity == Severity.ERROR] == []


OBS = "observation.state"
START = length(0)  # of the second episode
SECOND = range(START, START + length(1))


def put(key: str, values: dict[int, Any], number: int | None = None) -> Callable[[dict[str, Any]], None]:
    """Put values into rows of a column, or into one number of these rows."""

    def change(rows: dict[str, Any]) -> None:
        for row, value in values.items():
            if number is None:
                rows[key][row] = value
            else:
                rows[key][row][number] = value

    return change


def frozen_episode(rows: dict[str, Any]) -> None:
    for row in SECOND:
        rows["observation.state"][row] = rows["observation.state"][START]


def flipped(rows: dict[str, Any]) -> None:
    for row in SECOND[7:12]:
        rows["observation.state"][row][2:] = [-x for x in rows["observation.state"][row][2:]]


def lost_row(rows: dict[str, Any]) -> None:
    for values in rows.values():
        values.pop()


JUMP = put("action", {START + 6: -1.9}, 0)


ERROR, WARNING = Severity.ERROR, Severity.WARNING


# The damage; what is found: how severe, by which check, where and what.
DAMAGED_NUMBERS = (
    (
        put(OBS, {START + 4: nan, START + 9: inf}, 1),
        ERROR,
        "finite",
        OBS,
        "2 frames .* first in episode 1, frame 4: b.pos",
    ),
    (put(OBS, dict.fromkeys(SECOND, 0.25), 0), WARNING, "frozen", f"{OBS}: a.pos", "does not change in episode 1,"),
    (frozen_episode, WARNING, "frozen", OBS, "nothing changes in episode 1"),
    (flipped, WARNING, "jumps", f"{OBS}: tool", "2 times in 1 episodes, first in episode 1, frame 7"),
    (JUMP, WARNING, "jumps", "action: a.pos", "2 times in 1 episodes, first in episode 1, frame 6"),
    (put(OBS, {5: 2.5}, 0), WARNING, "limits", f"{OBS}: a.pos", "to 2.5; the robot's limits are -2 and 2"),
    (
        put("control.late", dict.fromkeys(range(10), True)),
        WARNING,
        "timing",
        "control.late",
        "10 of 135 frames were late",
    ),
    (put("timestamp", {START + 3: 0.31}), ERROR, "timing", "file-000", "1 timestamps .* in episode 1, frame 3: 0.31 s"),
    (put("frame_index", {2: 3, 3: 2}), ERROR, "counts", "file-000", "is 3 in row 2, where meta/episodes has 2"),
    (put("task_index", {8: 2}), ERROR, "counts", "file-000", "task_index is 2; there are 2 instructions"),
    (lambda rows: rows.pop("control.age"), ERROR, "schema", "file-000", "no column control.age"),
    (lost_row, ERROR, "counts", "file-000", "134 frames; its episodes have 135"),
    (
        put("control.age", {3: nan}),
        Severity.NOTE,
        "finite",
        "control.age",
        "episode 0, frame 3",
    ),  # nobody learns from it
)


@pytest.mark.law
def test_damaged_numbers_are_found(valid: Path, tmp_path: Path) -> None:
    root = copy(valid, tmp_path)
    origin = data_file(root).read_bytes()
    for damage, severity, check, where, what in DAMAGED_NUMBERS:
        data_file(root).write_bytes(origin)
        edit(data_file(root), damage)
        found = check_dataset(root, limits)
        matching = [finding for finding in found.findings if (finding.severity, finding.check) == (severity, check)]
        assert any(where in one.where and re.search(what, one.what) for one in matching), found.findings
        assert all(one.remedy for one in matching if severity is not Severity.NOTE)
        # The change of the data changed the statistics, too; there are no other findings.
        assert {one.check for one in bad(found)} <= ({check, "stats", "limits"} if severity else set())


def test_a_number_that_rests_at_an_end_of_its_range_is_no_broken_sensor(valid: Path, tmp_path: Path) -> None:
    """It may be clipped there."""
    root = copy(valid, tmp_path)
    for value in (-2.0, 2.0):
        edit(data_file(root), put("observation.state", dict.fromkeys(SECOND, value), 0))
        assert not [one for one in bad(check_dataset(root)) if one.check == "frozen"]


def test_a_column_with_gaps_is_found_and_the_rest_is_checked(valid: Path, tmp_path: Path) -> None:
    def gap(rows: dict[str, Any]) -> None:
        rows["observation.state"][3] = None
        frozen_episode({"observation.state": rows["observation.state"]})
        JUMP(rows)

    root = copy(valid, tmp_path)
    edit(data_file(root), gap)
    found = bad(check_dataset(root))
    assert [one.what for one in found if one.check == "finite"] == ["1 frames hold nothing"]
    assert [one.where for one in found if one.check == "jumps"] == ["action: a.pos"]


def episodes_file(root: Path) -> Path:
    return next((root / "meta/episodes").rglob("*.parquet"))


def cut_footer(root: Path) -> None:
    path = data_file(root)
    path.write_bytes(path.read_bytes()[:-20])


def flip_a_byte(root: Path) -> None:
    path = data_file(root)
    content = bytearray(path.read_bytes())
    content[len(content) // 4] ^= 0xFF
    path.write_bytes(content)


def info(**values: Any) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "meta/info.json", lambda content: content.update(values))


def stats(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "meta/stats.json", change)


def row(name: str, value: int | None) -> Callable[[Path], None]:
    return lambda root: edit(episodes_file(root), lambda rows: rows[name].__setitem__(2, value))


def no_shape(root: Path) -> None:
    edit_json(root / "meta/info.json", lambda content: content["features"]["action"].pop("shape"))


def names(root: Path, *given: str) -> None:
    edit_json(root / "meta/info.json", lambda content: content["features"]["action"].update(names=list(given)))


FILE = "data/chunk-000/file-000.parquet"
DAMAGE: dict[str, tuple[Callable[[Path], Any], str, str, str]] = {
    "footer": (cut_footer, "files", FILE, "cannot be read"),
    "byte": (flip_a_byte, "files", FILE, "cannot be read"),
    "no data": (lambda root: data_file(root).unlink(), "files", FILE, "missing"),
    "tasks": (lambda root: (root / "meta/tasks.parquet").write_bytes(b"PAR1"), "files", "tasks", "cannot be read"),
    "no stats": (lambda root: (root / "meta/stats.json").unlink(), "stats", "meta/stats.json", "missing"),
    "half stats": (lambda root: (root / "meta/stats.json").write_text("{"), "stats", "stats.json", "cannot be read"),
    "mean": (stats(lambda all_: all_["action"]["mean"].reverse()), "stats", "action", "mean is not that of the data"),
    "stats of": (stats(lambda all_: all_.pop("action")), "stats", "meta/stats.json: action", "no min"),
    "frames": (info(total_frames=134), "counts", "info.json", "counts 134 frames; the episodes have 135"),
    "episodes": (info(total_episodes=7), "counts", "meta/episodes", "1 episode is not described, 6 first"),
    "names": (lambda root: names(root, *"abc"), "schema", "meta/info.json: action", "3 names for 2 numbers"),
    "shape": (no_shape, "schema", "meta/info.json: action", "it has the shape None"),
    "start": (row("dataset_from_index", 40), "counts", "meta/episodes", "episode 2 "),
    "no place": (row("data/file_index", None), "schema", "meta/episodes", "episode 2 has None as data/file_index"),
    "no frame": (row("length", 0), "schema", "meta/episodes", "episode 2 has no frames"),
    "twice": (row("episode_index", 1), "counts", "meta/episodes", "episode 1 is described twice"),
}


def test_one_name_for_several_numbers_is_valid(valid: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(valid, tmp_path / "d"))
    names(root, "actions")
    assert check_dataset(root).is_valid


@each_case("value", [None, 0, -5])
def test_a_row_that_cannot_be_read_is_one_finding(valid: Path, tmp_path: Path, value: int | None) -> None:
    """What is not known of its episode is not held against the others, nor against the counts of `info.json`."""
    root = Path(shutil.copytree(valid, tmp_path / "d"))
    row("length", value)(root)
    errors = [one for one in check_dataset(root).findings if one.severity == Severity.ERROR]
    assert [one.check for one in errors if one.where != FILE] == ["schema"], errors
    edit(episodes_file(root), lambda rows: rows["episode_index"].__setitem__(2, None))
    assert any("episode_index of a row is null" in one.what for one in check_dataset(root).findings)


def test_damaged_files_are_found(valid: Path, tmp_path: Path) -> None:
    for case, (damage, check, where, what) in DAMAGE.items():
        root = Path(shutil.copytree(valid, tmp_path / case))
        damage(root)
        found = check_dataset(root)
        matching = [
            finding for finding in found.findings if (finding.severity, finding.check) == (Severity.ERROR, check)
        ]
        assert any(where in one.where and what in one.what for one in matching), (case, found.findings)
        assert {finding.check for finding in found.findings} <= set(CHECKS)
        assert found.worst == Severity.ERROR


def test_a_video_that_is_too_short_or_too_fast_is_found(video_dataset: Path, tmp_path: Path) -> None:
    root = copy(video_dataset, tmp_path)
    video, other = next((root / "videos").rglob("*.mp4")), tmp_path / "other"
    record(other, video=True, finalize=False)
    short = min((other / "videos").rglob("*.mp4"))
    assert bad(check_dataset(root, limits)) == []
    shutil.copy(short, video)
    (one,) = bad(check_dataset(root))
    assert (one.check, one.what) == ("video", "it has 20 frames; its episodes have 135")
    assert bad(check_dataset(root, videos=False)) == []
    encoder = CameraEncoder(tmp_path / "fast.mp4", FPS + 2, (32, 48), VideoSettings())
    for _ in range(135):
        encoder.add(np.zeros((32, 48, 3), np.uint8))
    encoder.finish()
    shutil.copy(tmp_path / "fast.mp4", video)  # as many frames, of which no loader finds most
    (one,) = bad(check_dataset(root))
    assert (one.check, one.severity) == ("video", Severity.ERROR)
    assert one.what.startswith(
        "its frames are not 0.1 s apart: frame 4 is shown 0.333 s after the first, and due after 0.4"
    )
    video.write_bytes(b"no video")
    (one,) = bad(check_dataset(root))
    assert (one.check, one.severity) == ("video", Severity.ERROR)


def test_a_dataset_without_a_success_is_warned_of(tmp_path: Path) -> None:
    (one,) = bad(check_dataset(record(tmp_path / "d", outcome="collision")))
    assert (one.check, one.what) == ("outcome", "none succeeded: collision 6")


def record_with_lerobot(root: Path) -> Path:
    """Record with LeRobot, and with no columns that its own edits cannot copy, such as matrices of integers."""
    features = {key: {**FEATURES[key], "names": None} for key in ("observation.state", "action")}
    dataset = LeRobotDataset.create("t/stock", FPS, features, root=root, use_videos=False)
    for episode in range(4):
        values = columns(episode)
        for frame in range(length(episode)):
            dataset.add_frame({**{key: values[key][frame] for key in features}, "task": f"task {episode % 2}"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("source", ["ours", "stock"])
def test_datasets_edited_by_lerobot_have_warnings_of_unused_statistics(valid, tmp_path, source, capsys, monkeypatch):
    root = copy(valid, tmp_path) if source == "ours" else record_with_lerobot(tmp_path / "stock")
    monkeypatch.setenv("COLUMNS", "200")
    dataset, again = loader_support.stock(root), loader_support.stock(root)
    folder = tmp_path / "edited"
    delete_episodes(dataset, [1], output_dir=folder / "deleted", repo_id="t/deleted")
    merge_datasets([dataset, again], output_repo_id="t/merged", output_dir=folder / "merged")
    split_dataset(dataset, {"first": [0, 1], "last": [2, 3]}, output_dir=folder)
    stale = set()
    for name in ("deleted", "merged", "first", "last"):
        found = [one for one in bad(check_dataset(folder / name)) if one.check == "stats"]
        assert {one.severity for one in found} <= {Severity.WARNING}, (name, found)
        assert main.main(["check", str(folder / name)]) == 0
        assert all(one.where in capsys.readouterr().out.replace("\n", "") for one in found[:1])
        stale |= {one.where.removeprefix("meta/stats.json: ") for one in found}
    assert {"index", "episode_index"} <= stale <= {"index", "episode_index", "task_index"}
    # What a policy is normalised with stays an error there, too.
    edit_json(folder / "merged/meta/stats.json", lambda all_: all_["action"]["mean"].reverse())
    assert [
        finding.where for finding in check_dataset(folder / "merged").findings if finding.severity == Severity.ERROR
    ] == ["meta/stats.json: action"]
