"""What a pull does with its target folder, and with some episodes. From a Hub on this machine."""

import shutil
from pathlib import Path

import pytest

from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.remote import pull as remote_pull
from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.errors import DatasetError, DatasetExistsError, DatasetLockedError, DatasetWriteError, TransferError
from tests.datasets import support
from tests.datasets.support import snapshot as content
from tests.fake_hub.fixtures import EPISODES, send
from tests.fake_hub.hub import FakeHub, Fault


def test_some_episodes_bring_only_their_files_and_load(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    send(root)
    target = tmp_path / "e"
    hub.reset()
    report = pull(HubDataset("me/d"), target, select=lambda folder: [0, 1])
    assert report.episodes == [0, 1]
    data = {path for path in content(target) if path.startswith(("data/", "videos/"))}
    assert data < load_state(root).files([0, 1]) < layout.recorded_files(root)
    hub.reset()
    dataset = LeRobotDataset("t/t", root=target, episodes=[0, 1], video_backend="pyav")
    assert len(dataset) == support.length(0) + support.length(1)
    assert dataset[len(dataset) - 1][support.CAMERA].shape == (3, 32, 48)
    assert not hub.requests
    with pytest.raises(DatasetError, match="some episodes of a dataset only"):
        send(target)
    # More of them are added; all of them make it whole.
    assert pull(HubDataset("me/d"), target, select=lambda folder: [5]).episodes == [0, 1, 5]
    assert not any(path in line for path in data for line in hub.asked("^GET .*/resolve/"))
    assert pull(HubDataset("me/d"), target).episodes is None
    assert content(target) == content(root)
    assert support.verify(target, EPISODES, video=True) == EPISODES


def test_episodes_that_do_not_exist(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    with pytest.raises(DatasetError, match=r"no episode 6.*from 0 to 5"):
        pull(HubDataset("me/d"), tmp_path / "e", select=lambda folder: [6])
    assert list(tmp_path.iterdir()) == [root]


def test_folders_that_hold_something_else_are_never_replaced(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    (tmp_path / "like/data/chunk-000").mkdir(parents=True)
    (tmp_path / "like/data/chunk-000/file-777.parquet").write_text("mine")
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    (tmp_path / "empty").mkdir()
    for name in ("file", "full", "like"):
        with pytest.raises(DatasetExistsError, match="Choose another folder"):
            pull(HubDataset("me/d"), tmp_path / name, replace=True)
    assert content(tmp_path / "like") == {"data/chunk-000/file-777.parquet": b"mine"}
    pull(HubDataset("me/d"), tmp_path / "empty")
    assert content(tmp_path / "empty") == content(root)
    with pytest.raises(DatasetWriteError, match=r"not a folder|Not a directory"):
        pull(HubDataset("me/d"), tmp_path / "file" / "below")


def test_a_full_disk_is_seen_before_and_during(hub: FakeHub, root: Path, tmp_path: Path, monkeypatch) -> None:
    send(root)
    usage = shutil.disk_usage(tmp_path)
    for free in (100, sum(map(len, content(root).values()))):  # a disk is not filled to its last byte
        with monkeypatch.context() as patch:
            patch.setattr(remote_pull.shutil, "disk_usage", lambda path, free=free: usage._replace(free=free))
            with pytest.raises(TransferError, match=r"MB are missing.* MB free"):
                pull(HubDataset("me/d"), tmp_path / "e")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("huggingface_hub.file_download.http_get", full)
        with pytest.raises(TransferError, match=r"No space left on device.*Free some space"):
            pull(HubDataset("me/d"), tmp_path / "e")
    assert not (tmp_path / "e").exists()
    pull(HubDataset("me/d"), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


def test_what_is_not_valid_there_comes_as_it_is_and_is_reported(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    files = dict(hub.dataset("me/d").files())
    lost = next(path for path in files if path.startswith("videos/"))
    del files[lost]
    commit = hub.dataset("me/d").add("torn", files)
    report = pull(HubDataset("me/d", commit), tmp_path / "e")
    assert lost in report.problem
    blob = files[layout.INFO]
    files[layout.INFO] = type(blob)(blob.content.replace(b"v3.0", b"v2.1"), lfs=False)
    hub.dataset("me/d").add("old", files)
    hub.reset()
    with pytest.raises(DatasetError, match=r"format v2\.1"):
        pull(HubDataset("me/d", "old"), tmp_path / "f")
    assert not hub.asked("GET .*/resolve/.*/data/")  # refused before everything was fetched


def test_what_is_in_use_is_neither_pushed_nor_pulled_to(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    target, other_pull = tmp_path / "e", tmp_path / ".e.pull"
    other_pull.mkdir()
    fetch = lambda: pull(HubDataset("me/d"), target)  # noqa: E731
    for place, move in ((root, lambda: send(root)), (other_pull, fetch), (target, fetch)):
        lock = RootLock(place)
        with pytest.raises(DatasetLockedError):
            move()
        lock.release()
        move()
    assert content(target) == content(root)


def break_off(hub: FakeHub, target: Path, path: str) -> None:
    """Pull over what is there, and fail at one file."""
    hub.faults = [Fault(f"^(GET|HEAD) .*/resolve/.*/{path}", times=-1, status=403)]
    with pytest.raises(TransferError):
        pull(HubDataset("me/d"), target, replace=True)
    hub.faults = []


def test_what_an_attempt_for_another_version_left_gets_into_no_dataset(hub, root, tmp_path):
    send(root)
    target, old = tmp_path / "e", content(root)
    commit = hub.dataset("me/d").branches["main"]
    pull(HubDataset("me/d"), target)
    (target / layout.STATS).write_text("{}")
    before = content(target)
    break_off(hub, target, layout.STATS)  # files of the dataset are linked beside it
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    send(root)
    break_off(hub, target, layout.STATS)  # with the info.json of the longer one
    assert content(target) == before  # not written through a link
    pull(HubDataset("me/d", commit), target, replace=True)
    assert content(target) == old


def test_episodes_of_a_replaced_dataset_are_not_requested(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    target = tmp_path / "e"
    pull(HubDataset("me/d"), target, select=lambda folder: [5])
    target.chmod(0o700)
    delete(root, [0, 1, 2])
    send(root, replace=True)
    report = pull(HubDataset("me/d"), target, select=lambda folder: [0], replace=True)
    assert report.episodes == [0]
    assert target.stat().st_mode & 0o777 == 0o700  # the permissions are kept


def test_a_folder_named_by_dots_is_the_folder(hub: FakeHub, root: Path, tmp_path: Path, monkeypatch) -> None:
    send(root)
    pull(HubDataset("me/d"), tmp_path / "e")
    (tmp_path / "e" / layout.STATS).write_text("{}")
    monkeypatch.chdir(tmp_path / "e/meta")
    assert pull(HubDataset("me/d"), "..", replace=True).fetched == [layout.STATS]
    assert content(tmp_path / "e") == content(root)
