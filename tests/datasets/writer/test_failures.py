"""Bad disks, bad files and bad callers: the error says what is wrong, and nothing that was saved is touched."""

import contextlib
import errno
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.storage import disk, layout
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import (
    DatasetCorruptError,
    DatasetError,
    DatasetExistsError,
    DatasetLockedError,
    DatasetMismatchError,
    DatasetWriteError,
)
from tests.datasets import support
from tests.datasets.edit_support import record


@contextlib.contextmanager
def stop_at(monkeypatch: pytest.MonkeyPatch, step: int, error: BaseException) -> Iterator[list[str]]:
    """Raise `error` instead of the step with this number; yields the steps seen."""
    seen: list[str] = []

    def before_step(action: str, path: Path) -> None:
        seen.append(action)
        if len(seen) == step + 1:
            raise error

    with monkeypatch.context() as patch:
        patch.setattr(disk, "_before_step", before_step)
        yield seen


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("video", [False, True])
def test_a_disk_that_fails_at_any_step_of_a_save(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, video: bool) -> None:
    """The failing episode is refused with a clear error; those before and after it are complete."""
    recorder = support.create(tmp_path / "d", video=video)
    support.record(recorder, video=video)
    step, done = 0, False
    while not done:
        saved = recorder.num_episodes
        writer = support.fill(recorder.begin_episode(), saved, video=video)
        with stop_at(monkeypatch, step, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "x")) as seen:
            failure = None
            try:
                recorder.save(writer, task=support.task(saved), metadata=support.metadata(saved))
            except DatasetWriteError as error:
                failure = str(error)
        done = len(seen) <= step
        assert failure is None or ("No space left on device" in failure and "Free some space" in failure)
        if failure is not None:
            with pytest.raises(DatasetError, match="no episode of this recording that can be taken back"):
                recorder.drop_last()  # which would be the one before, or none
        # Only an episode whose commit had happened may be there although the call failed, in the clean-up after it.
        assert recorder.num_episodes in (saved, saved + 1)
        if not done:
            support.record(recorder, video=video)
        step += 1
    recorder.finalize()
    assert step > 10
    assert support.verify(tmp_path / "d", recorder.num_episodes, video=video, stats=True) == recorder.num_episodes


@pytest.mark.law
@pytest.mark.parametrize("before", [1, 2], ids=["save", "taking back"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "x")], ids=str)
def test_a_failure_at_any_step_of_a_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: int, error: BaseException
) -> None:
    """Leaving the block finalises what the disk says: the last episode is there or not, and nothing is corrupted."""
    step, done = 0, False
    while not done:
        root = tmp_path / str(step)
        with support.create(root) as recorder:
            for _ in range(before):
                support.record(recorder)
            with (
                stop_at(monkeypatch, step, error) as seen,
                contextlib.suppress(KeyboardInterrupt, DatasetWriteError),
            ):
                support.record(recorder) if before == 1 else recorder.drop_last()
            done = len(seen) <= step
        assert support.read_back(root) in (1, 2)
        assert not repair(root)
        step += 1
    assert support.read_back(root) == 3 - before


@contextlib.contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_the_kernel_refuses_a_video(tmp_path: Path) -> None:
    """The encoder runs in a thread; its error arrives at the next image or at save, and nobody waits forever."""
    root = tmp_path / "d"
    features = {"camera": {"dtype": "video", "shape": (64, 64, 3), "names": None}}
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    with DatasetRecorder.create("t/t", 10, features, robot_type="toy", root=root) as recorder:
        for limited in (False, True):
            writer = recorder.begin_episode()
            with file_size_limit(60_000 if limited else resource.RLIM_INFINITY):
                context = pytest.raises(DatasetWriteError) if limited else contextlib.nullcontext()
                with context:
                    for _ in range(60 if limited else 2):
                        writer.add_image("camera", noise)
                    recorder.save(writer, task="t", metadata={})
        assert recorder.num_episodes == 1
    assert dataset_info(root).frames == 2
    assert not repair(root)


def test_roots_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DatasetWriteError, match="is a file, not a folder"):
        support.create(tmp_path / "file" / "d")
    with pytest.raises(DatasetExistsError, match="is not a folder"):
        support.create(tmp_path / "file")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").touch()
    with pytest.raises(DatasetExistsError, match="Resume it"):
        support.create(tmp_path / "folder")
    for call in (support.resume, repair, dataset_info):
        with pytest.raises(DatasetError, match=r"no meta/info\.json"):
            call(tmp_path / "folder")
        with pytest.raises(DatasetError, match="dataset"):
            call(tmp_path / "nowhere")
    assert (tmp_path / "file").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_only_one_writer_at_a_time(tmp_path: Path) -> None:
    root = tmp_path / "d"
    root.mkdir()  # an empty folder becomes a dataset
    recorder = support.create(root)
    support.record(recorder)
    files = os.listdir("/proc/self/fd")
    for call in (support.create, support.resume, repair):
        with pytest.raises(DatasetLockedError, match="is being recorded, repaired, edited or copied"):
            call(root)
    assert len(os.listdir("/proc/self/fd")) == len(files)
    recorder.finalize()
    with support.resume(root) as again:
        assert again.num_episodes == 1
        with pytest.raises(DatasetLockedError):
            support.resume(root)
    assert not repair(root)


def test_a_failed_finalize_gives_the_lock_back_and_can_be_followed_by_more(tmp_path: Path) -> None:
    root = tmp_path / "d"
    recorder = support.create(root)
    for _ in range(3):
        support.record(recorder)
    with file_size_limit(1000), pytest.raises(DatasetWriteError):
        recorder.finalize()
    assert repair(root)
    assert support.record(recorder) == 3
    with pytest.raises(DatasetLockedError):
        repair(root)
    recorder.finalize()
    assert support.verify(root, 4, stats=True) == 4


def test_a_dataset_that_does_not_fit_is_not_resumed(tmp_path: Path) -> None:
    root = record(tmp_path / "d", [0, 1], video=True)
    before = support.snapshot(root)

    def attempt(**changes: object) -> None:
        options = {"fps": 10, "features": support.VIDEO_FEATURES, "robot_type": "toy", "recording": {"seed": 1}}
        DatasetRecorder.resume("t/t", root=root, **{**options, **changes})  # type: ignore[arg-type]

    features = support.VIDEO_FEATURES
    wider = {**features, "observation.state": {"dtype": "float32", "shape": (4,), "names": None}}
    cases = {
        "fps: recorded 10, requested 20": {"fps": 20},
        'robot_type: recorded "toy", requested "arm"': {"robot_type": "arm"},
        r"recording.seed: recorded 1, requested 2": {"recording": {"seed": 2}},
        "recording.brain: not recorded, requested": {"recording": {"seed": 1, "brain": {"gain": 1}}},
        r"features.observation.state.shape: recorded \[3\], requested \[4\]": {"features": wider},
        "features.event: recorded .*, not requested": {"features": {k: v for k, v in features.items() if k != "event"}},
        "order of features": {"features": dict(reversed(features.items()))},
        "video.crf: recorded 23, requested 30": {"video": VideoSettings(crf=30)},
    }
    for words, changes in cases.items():
        with pytest.raises(DatasetMismatchError, match=words):
            attempt(**changes)
    assert support.snapshot(root) == before


def test_a_dataset_of_another_program_is_read_but_not_resumed(tmp_path: Path) -> None:
    root = record(tmp_path / "d", [0, 1])
    (root / "meta/bhd.json").unlink()
    (root / "data/chunk-000/file-007.parquet").write_bytes(b"theirs")
    with pytest.raises(DatasetMismatchError, match="not recorded by this program"):
        support.resume(root)
    assert len(dataset_info(root).episodes) == 2
    assert not repair(root)
    assert (root / "data/chunk-000/file-007.parquet").exists()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def garble(path: Path) -> None:
    path.write_bytes(os.urandom(path.stat().st_size))


DAMAGES: list[tuple[str, Callable[[Path], None]]] = [
    ("data/chunk-000/file-000.parquet", cut),
    ("data/chunk-000/file-000.parquet", garble),
    ("data/chunk-000/file-000.parquet", Path.unlink),
    ("meta/episodes/chunk-000/file-000.parquet", cut),
    ("meta/episodes/chunk-000/file-000.parquet", Path.unlink),
    ("meta/tasks.parquet", garble),
    ("meta/info.json", cut),
    ("meta/bhd.json", garble),
    (f"videos/{support.CAMERA}/chunk-000/file-000.mp4", Path.unlink),
]


RECOVERABLE = [one for one in DAMAGES if one[0][:8] in ("meta/epi", "meta/tas") or one == DAMAGES[0]]


def test_a_corrupt_file_is_named_and_nothing_is_overwritten(tmp_path: Path) -> None:
    root = record(tmp_path / "d", [0, 1], video=True)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    for name, damage in DAMAGES:
        origin = (root / name).read_bytes()
        damage(root / name)
        before = support.snapshot(root)
        calls = [lambda: support.resume(root, video=True), lambda: dataset_info(root), lambda: repair(root)]
        # What `repair` recovers is in test_salvage_ours.py.
        for call in calls[: 2 if (name, damage) in RECOVERABLE else 3]:
            with pytest.raises(DatasetCorruptError, match="Restore this file") as caught:
                call()
            assert name.split("/chunk", maxsplit=1)[0] in str(caught.value)
        assert support.snapshot(root) == before
        (root / name).write_bytes(origin)


def test_an_error_in_the_block_is_not_hidden_by_one_of_finalising(tmp_path, monkeypatch):
    recorder = support.create(tmp_path / "d")
    support.record(recorder)
    with pytest.raises(ZeroDivisionError) as caught, stop_at(monkeypatch, 3, OSError(errno.EIO, "broken")), recorder:
        raise ZeroDivisionError
    assert "could not be finalised" in caught.value.__notes__[0]
    assert support.read_back(tmp_path / "d") == 1


@pytest.mark.parametrize("video", [False, True])
def test_what_counts_is_on_the_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, video: bool) -> None:
    """With `fsync`, an episode exists when all of it survives a power failure, also the folders that name its files."""
    root, staged, fsync = tmp_path / "d", tmp_path / "d" / layout.STAGING, os.fsync
    safe: set[int] = set()
    looks = 0

    def flush(handle: int) -> None:
        fsync(handle)
        safe.add(os.fstat(handle).st_ino)

    def look(action: str, path: Path) -> None:
        nonlocal looks
        if (action, path) == ("rename", root / layout.INFO):
            looks += 1
            there = [one for one in (root, *root.rglob("*")) if not one.is_relative_to(staged)]
            there += staged.glob("save/info.json")
            assert [str(one) for one in there if one.stat().st_ino not in safe] == []

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(disk, "_before_step", look)
    with support.create(root, video=video, fsync=True) as recorder:
        for episode in range(2):
            support.record(recorder, video=video)
            assert looks == episode + 1
    assert support.read_back(root) == 2
