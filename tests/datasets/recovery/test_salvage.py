"""What stock LeRobot leaves behind SIGKILL is recovered: every whole episode, as it would have been."""

import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.datasets.edit.edits import edits_of, keep
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.recovery.repair import repair, restore_committed
from bhd_lerobot.datasets.recovery.statistics import stats_of
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.validate.dataset import Severity, check_dataset
from bhd_lerobot.errors import ConfigError, DatasetCorruptError, DatasetLockedError
from tests.datasets import corruption_jobs, support
from tests.datasets.edit_support import Episode, assert_valid, content
from tests.forks import Fork

CAMERA = "observation.images.top"
Recorded = Callable[..., Path]


def go_on(root: Path, video: str, episodes: int, die: str = "never", **job: Any) -> Path:
    """Record some episodes more, or the first ones."""
    job |= {"root": str(root), "video": video, "episodes": episodes, "die": die}
    status = Fork(corruption_jobs.run, job).wait()
    assert status == (0 if die == "never" else -signal.SIGKILL)
    return root


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Give a copy of a recording; one of a kind is made for all tests."""
    origins = tmp_path_factory.mktemp("origins")

    def copy(root: Path, video: str, episodes: int, die: str = "never") -> Path:
        origin = origins / f"{video} {episodes} {die}"
        if not origin.exists():
            go_on(origin, video, episodes, die)
        return Path(shutil.copytree(origin, root))

    return copy


@pytest.fixture(scope="module")
def truth(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Episode]]:
    """What a recording that nobody kills is like."""
    folder = tmp_path_factory.mktemp("truth")
    episodes = {"none": 5, "video": 3, "image": 3}
    return {video: content(recorded(folder / video, video, count)) for video, count in episodes.items()}


def loaded(root: Path, frames: int) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("t/t", root=root, video_backend="pyav")
    assert len(dataset) == frames
    assert dataset[frames - 1]["task"]


@pytest.mark.thorough(but=3)
@pytest.mark.parametrize(
    "case",
    [
        ("none", 1, "saved", 1),
        ("none", 4, "saved", 4),
        ("none", 3, "frames", 3),
        ("none", 3, "counting", 3),  # its frames are on the disk, though info.json does not count it
        ("video", 3, "saved", 3),
        ("video", 3, "encoding", 3),  # its images are still there
        ("video", 2, "frames", 2),
        ("video", 3, "counting", 3),
        ("video", 3, "joining", 3),  # its video is finished, in a temporary folder
        ("stream", 3, "joining", 3),
        ("stream", 3, "frames", 3),
        ("stream", 3, "encoding", 3),  # its video lies in a temporary folder
        ("image", 3, "saved", 3),
    ],
)
def test_every_whole_episode_is_recovered(recorded, truth, tmp_path, case):
    video, episodes, die, recovered = case
    root = recorded(tmp_path / "d", video, episodes, die)
    report = repair(root)
    assert report.episodes == recovered
    assert bool(report.lost) == (recovered < episodes)
    found = content(root)
    expected = truth["video" if video == "stream" else video][:recovered]
    for one, wanted in zip(found, expected, strict=True):
        assert (one.task, one.columns) == (wanted.task, wanted.columns)
        assert one.videos.keys() == wanted.videos.keys()
        for key in one.videos:
            for a, b in zip(one.videos[key], wanted.videos[key], strict=True):
                # A video that had to be encoded anew, or by the streaming encoder, may round otherwise.
                assert abs(np.frombuffer(a, np.uint8).astype(int) - np.frombuffer(b, np.uint8)).max() <= 3
    assert_valid(root)
    loaded(root, report.frames)
    assert report.aside is not None
    assert (report.aside / "images").exists() == (video == "video" and die in ("encoding", "frames"))
    assert not repair(root)  # and now there is nothing to do


def test_losses_are_reported(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "stream", 3, "encoding")
    for folder in root.glob("tmp*"):
        shutil.rmtree(folder)
    (tmp_path / "d.damaged-1").mkdir()  # of an earlier repair
    report = repair(root)
    assert report.aside == tmp_path / "d.damaged-2"
    assert report.lost == (f"episode 2: no whole video of {CAMERA}",)
    text = str(report)
    assert "meta/episodes is corrupt" in text
    assert f"lost: episode 2: no whole video of {CAMERA}" in text
    assert str(report.aside) in text


def test_a_session_that_went_on_and_was_killed(recorded: Recorded, truth: dict, tmp_path: Path) -> None:
    """Also what was marked before it survives."""
    root = recorded(tmp_path / "d", "none", 2)
    mark(root, [1], outcome="success", note="seen")
    go_on(root, "none", 2, "frames")
    assert repair(root).episodes == 4
    found = content(root)
    assert [(e.task, e.columns) for e in found] == [(e.task, e.columns) for e in truth["none"][:4]]
    assert [e.metadata.get("bhd/outcome") for e in found] == [None, "success", None, None]
    assert [edit.get("note") for edit in edits_of(root)] == ["seen", None]
    assert edits_of(root)[-1]["episodes"] == [0, 1, 2, 3]
    go_on(root, "none", 1)  # LeRobot itself goes on with it
    loaded(root, sum(map(corruption_jobs.length, range(5))))


def test_random_kills_lose_no_saved_episode(recorded: Recorded, tmp_path: Path) -> None:
    rng = random.Random(11)
    another = recorded(tmp_path / "another", "none", 1)
    for kill in range(3):
        root, progress = tmp_path / f"d{kill}", tmp_path / f"progress{kill}"
        job = {"video": "none", "episodes": 10_000, "die": "never", "progress": str(progress)}
        victim = Fork(corruption_jobs.run, {"root": str(root), **job})
        wanted = rng.randrange(2, 8)
        while not progress.exists() or progress.read_text().count("\n") < wanted:
            time.sleep(0.002)
        time.sleep(rng.random() * 0.03)
        victim.kill()
        saved = progress.read_text().count("\n")
        if (root / "meta/info.json").read_text():
            report = repair(root)
        else:  # LeRobot was about to write it; the message says what helps
            with pytest.raises(DatasetCorruptError, match="--info OTHER"):
                repair(root)
            report = repair(root, another)
        assert saved <= report.episodes <= saved + 1
        assert_valid(root)


def test_a_torn_video_costs_the_episodes_behind_the_tear(recorded: Recorded, truth: dict, tmp_path: Path) -> None:
    origin = recorded(tmp_path / "origin", "video", 3, "saved")
    size = next(origin.glob("videos/*/*/*.mp4")).stat().st_size
    seen = set()
    for missing in (1, 60, 120, 180, 240, 300):
        root = shutil.copytree(origin, tmp_path / f"d{missing}")
        video = next(root.glob("videos/*/*/*.mp4"))
        os.truncate(video, size - missing)
        try:
            report = repair(root)
        except DatasetCorruptError as error:
            assert "No whole episode" in str(error)  # noqa: PT017
            seen.add(0)
            continue
        assert report.lost
        seen.add(report.episodes)
        assert [e.videos for e in content(root)] == [e.videos for e in truth["video"][: report.episodes]]
        assert_valid(root)
    assert {2, 1} <= seen


def test_truncated_data_cost_the_episodes_behind_the_cut(recorded: Recorded, truth: dict, tmp_path: Path) -> None:
    origin = recorded(tmp_path / "origin", "none", 4, "saved")
    size = next(origin.glob("data/*/*.parquet")).stat().st_size
    for share in (0.3, 0.6, 0.9):
        root = shutil.copytree(origin, tmp_path / f"d{share}")
        os.truncate(next(root.glob("data/*/*.parquet")), int(size * share))
        report = repair(root)
        assert 1 <= report.episodes <= 3
        assert "bytes at its end" in report.lost[0]
        assert [e.columns for e in content(root)] == [e.columns for e in truth["none"][: report.episodes]]


def test_lost_instructions_are_reported_and_distinguished(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "none", 4, "saved")
    (root / "meta/tasks.parquet").write_bytes(b"PAR1")
    report = repair(root)
    assert any("meta/tasks.parquet" in line for line in report.lost)
    texts = [episode.task[0] for episode in content(root)]
    assert texts[0] == texts[3] != texts[1]
    assert all("lost" in text for text in texts)


def test_nothing_left_changes_nothing(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "none", 2, "saved")
    os.truncate(next(root.glob("data/*/*.parquet")), 40)
    before = support.snapshot(root)
    with pytest.raises(DatasetCorruptError, match=r"No whole episode of .* can be recovered; nothing was changed"):
        repair(root)
    assert support.snapshot(root) == before
    (root / "meta/info.json").write_text("{")
    with pytest.raises(DatasetCorruptError, match=rf"bhd-data repair {root} --info OTHER"):
        repair(root)


@pytest.mark.parametrize(("by", "episodes"), [("folder", 5), ("file", 1), ("hand", 5)])
def test_info_of_another_recording_is_used(recorded, truth, tmp_path, by, episodes):
    """Whatever it counts: that is no loss of this one."""
    root = recorded(tmp_path / "d", "none", 4, "saved")
    another = recorded(tmp_path / "another", "none", episodes)
    info = root / "meta/info.json"
    info.write_text("{")
    with pytest.raises(DatasetCorruptError, match=f"repair {root} --info OTHER"):
        repair(root)
    if by == "hand":
        shutil.copy(another / "meta/info.json", info)
        report = repair(root)
        assert ("its counts mean nothing" in str(report)) == (episodes > 4)
    else:
        report = repair(root, another if by == "folder" else another / "meta/info.json")
        assert "note:" not in str(report)
        assert (tmp_path / "d.damaged-1/meta/info.json").read_text() == "{"
    assert (report.episodes, report.lost) == (4, ())
    assert [e.columns for e in content(root)] == [e.columns for e in truth["none"][:4]]
    assert_valid(root)
    assert not repair(root)


def changed_info(source: Path, target: Path, change: dict[str, Any], fps: int = 10) -> Path:
    """Write an `info.json` with other features; those that are None are left out."""
    info = json.loads((source / "meta/info.json").read_text())
    features = {key: one for key, one in {**info["features"], **change}.items() if one is not None}
    target.write_text(json.dumps({**info, "features": features, "fps": fps}))
    return target


OTHER_INFO: tuple[tuple[dict[str, Any], str], ...] = (
    ({"action": None}, "it does not describe action"),
    ({"force": {"dtype": "float32", "shape": [1], "names": None}}, "it describes force, which is not there"),
    ({"action": {"dtype": "float32", "shape": [7], "names": None}}, "action has 7 numbers, but it has 2"),
    ({CAMERA: None}, f"it does not describe {CAMERA}"),
    ({}, "it states 25 frames a second, but the timestamps give 10"),
    ({"note": None}, "no frame of 1 data files can be read"),  # text is in no statistics
)


def test_info_of_another_robot_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "video", 3, "saved")
    info = root / "meta/info.json"
    origin = info.read_bytes()
    for (change, message), by_hand in itertools.product(OTHER_INFO, (False, True)):
        if by_hand and (not change or "note" in change):
            continue  # no file contradicts it then
        info.write_bytes(origin)
        donor = changed_info(root, tmp_path / "other.json", change, fps=10 if change else 25)
        if by_hand:
            shutil.copy(donor, info)
        else:
            info.unlink()
        before = support.snapshot(root)
        with pytest.raises(DatasetCorruptError if by_hand else ConfigError) as error:
            repair(root, None if by_hand else donor)
        assert message in str(error.value)
        assert str(info if by_hand else donor) in str(error.value)
        assert "--info" in str(error.value)
        assert support.snapshot(root) == before
        assert not (tmp_path / "d.damaged-1").exists()


def test_info_of_another_is_given_back_if_nothing_can_be_recovered(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "video", 3, "saved")
    donor = changed_info(root, tmp_path / "other.json", {})
    shutil.rmtree(root / "videos")
    for break_it in (lambda path: path.write_text("{"), Path.unlink):
        break_it(root / "meta/info.json")
        before = support.snapshot(root)
        with pytest.raises(DatasetCorruptError, match="No whole episode"):
            repair(root, donor)
        assert support.snapshot(root) == before
        assert not (tmp_path / "d.damaged-1").exists()


def test_a_camera_without_any_video_is_named(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "none", 2, "saved")
    (root / "meta/stats.json").unlink()
    camera = {"observation.images.rear": {"dtype": "video", "shape": [32, 48, 3], "names": None}}
    changed_info(root, root / "meta/info.json", camera)
    with pytest.raises(DatasetCorruptError, match=r"describes observation\.images\.rear, of which there is no video"):
        repair(root)


def test_a_recording_that_goes_on_is_left_alone(recorded: Recorded, tmp_path: Path) -> None:
    root = recorded(tmp_path / "d", "none", 2, "saved")
    path = next(root.glob("data/*/*.parquet"))
    code = "import sys; f = open(sys.argv[1], 'ab'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        with pytest.raises(DatasetLockedError, match=f"Process {process.pid} has"):
            repair(root)
        process.communicate("")
    assert repair(root).episodes == 2


@pytest.fixture(scope="module")
def sessions(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions of three episodes each, with a video of its own for each session."""
    root = recorded(tmp_path_factory.mktemp("sessions") / "d", "video", 3)
    return go_on(root, "video", 3)


def numbers(root: Path) -> list[int]:
    """Return which episodes a dataset holds, by their frames, after checking that their videos are theirs."""
    found = []
    for episode in content(root):
        number = int(episode.columns["observation.state"][0][2])
        for index, image in enumerate(episode.videos.get(CAMERA, [])):
            grey = 20 + (37 * number + 11 * index) % 200
            assert abs(float(np.frombuffer(image, np.uint8).mean()) - grey) < 4, (number, index)
        found.append(number)
    return found


@pytest.mark.parametrize(
    ("gone", "left"),
    [
        ("videos/observation.images.top/chunk-000/file-000.mp4", [3, 4, 5]),
        ("videos/observation.images.top/chunk-000/file-001.mp4", [0, 1, 2]),
        ("data/chunk-000/file-000.parquet", [3, 4, 5]),
        ("meta/episodes/chunk-000/file-001.parquet", [0, 1, 2, 3, 4, 5]),
        ("meta/episodes/chunk-000/file-000.parquet", [3, 4, 5]),  # whose the other video is can only be guessed
    ],
)
def test_a_lost_file_costs_its_own_episodes_only(sessions: Path, tmp_path: Path, gone: str, left: list[int]) -> None:
    root = shutil.copytree(sessions, tmp_path / "d")
    (root / gone).unlink()
    report = repair(root)
    assert numbers(root) == left
    assert bool(report.lost) == (len(left) < 6)
    assert_valid(root)


def test_a_video_that_was_being_moved_is_taken_from_the_folder_for_temporary_files(recorded, tmp_path, monkeypatch):
    """Unless it is another user's, for that folder is everybody's."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for owner in (os.getuid(), *([65534] if not os.getuid() else [])):
        root = recorded(tmp_path / f"d{owner}", "video", 3, "saved")
        video = next(root.glob("videos/*/*/*.mp4"))
        shutil.copy(video, tmp_path / "whole.mp4")
        os.chown(tmp_path / "whole.mp4", owner, -1)
        os.truncate(video, video.stat().st_size - 120)
        assert (repair(root).episodes == 3) == (owner == os.getuid())


def test_what_the_video_behind_a_torn_one_shows_is_not_guessed(sessions: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sessions, tmp_path / "d")
    shutil.rmtree(root / "meta/episodes")
    video = root / "videos/observation.images.top/chunk-000/file-000.mp4"
    os.truncate(video, video.stat().st_size - 120)
    repair(root)
    assert numbers(root) in ([0], [0, 1])


def test_a_video_with_unused_frames_is_valid(sessions: Path, tmp_path: Path) -> None:
    """LeRobot reads where the rows say; a video may hold more."""
    root = shutil.copytree(sessions, tmp_path / "d")
    video = root / "videos/observation.images.top/chunk-000/file-000.mp4"
    keep(root, [0, 2], tmp_path / "kept")
    # As if the rows of the kept ones pointed into the video that still holds all three.
    path = tmp_path / "kept/meta/episodes/chunk-000/file-000.parquet"
    shutil.copy(video, tmp_path / "kept/videos/observation.images.top/chunk-000/file-000.mp4")
    table = pq.read_table(path)
    for name, values in (("from_timestamp", [0.0, 1.1]), ("to_timestamp", [0.5, 1.8])):
        place = table.schema.get_field_index(f"videos/{CAMERA}/{name}")
        table = table.set_column(place, table.schema.field(place), pa.array(values))
    pq.write_table(table, path)
    assert numbers(tmp_path / "kept") == [0, 2]
    assert not repair(tmp_path / "kept")
    assert numbers(tmp_path / "kept") == [0, 2]


def test_an_episode_that_was_recorded_again(tmp_path: Path) -> None:
    """No file records which of its two attempts a video shows."""
    root = go_on(tmp_path / "d", "video", 4, "saved", again=2)
    report = repair(root)
    assert numbers(root) == [0, 1]
    assert "episode 2: a first attempt, which was recorded again" in report.lost


def test_a_kill_in_the_first_episode_of_a_second_session(recorded: Recorded, tmp_path: Path) -> None:
    """No count is wrong then, and yet LeRobot loads nothing: a file without a footer lies there."""
    root = recorded(tmp_path / "d", "video", 3)
    go_on(root, "video", 1, "encoding")
    assert [finding.check for finding in check_dataset(root).findings if finding.severity is Severity.ERROR] == [
        "files"
    ]
    assert repair(root).episodes == 4
    assert numbers(root) == [0, 1, 2, 3]
    loaded(root, 23)
    first = recorded(tmp_path / "first", "video", 1, "encoding")
    assert repair(first).episodes == 1


def test_our_own_dataset_that_lerobot_went_on_with(recorded: Recorded, tmp_path: Path) -> None:
    for count, die in ((1, "counting"), (2, "saved")):
        root = recorded(tmp_path / f"d{count}", "none", 3)
        (root / "meta/bhd.json").write_text(json.dumps({"format": 1, "recording": {"seed": 1}, "video": {}}))
        go_on(root, "none", count, die)
        if count == 1:  # our recorder does not throw away what it did not write
            with pytest.raises(DatasetCorruptError, match="bhd-data repair"):
                restore_committed(root, Disk())
        assert repair(root).episodes == 3 + count
        assert json.loads((root / "meta/bhd.json").read_text())["recording"]["edited"] == {"edit": "recovered"}


def test_statistics_that_only_some_episodes_have_are_left_out() -> None:
    """Those of depth are not computed, and of an episode whose row is lost there are none."""
    features = {"x": {"dtype": "float32", "shape": [1]}, "depth": {"dtype": "video", "shape": [4, 4, 1]}}
    tables = [pa.table({"x": np.arange(3, dtype=np.float32)})] * 2
    rows = [{"episode_index": index, "length": 3} for index in range(2)]
    depth = {"depth": {name: np.ones((1, 1, 1)) for name in ("min", "max", "mean", "std", "count")}}
    for stored, keys in (([depth, {}], {"x"}), ([depth, depth], {"x", "depth"})):
        found = stats_of(tables, features, Path(), rows, stored)
        assert found.keys() == keys
        assert {len(values) for stat in found.values() for values in stat.values()} == {2}
