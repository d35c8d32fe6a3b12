"""What lies below a URL is not what was put there: what is noticed, by what, and how it is repaired."""

import os
import shutil
from pathlib import Path

import fsspec
import pytest

from bhd_lerobot.datasets.remote.listing import MANIFEST
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetExistsError, TransferError
from tests.datasets import support
from tests.datasets.remote.store_fixtures import stored, use_s3
from tests.hub_server.fixtures import content

pytest_plugins = ["tests.datasets.remote.store_fixtures"]

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def root(few_files: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(few_files, tmp_path / "d"))


def flip(url: str, path: str) -> None:
    """Change one byte of a file below a URL."""
    fs, folder = fsspec.core.url_to_fs(url)
    broken = bytearray(fs.cat_file(f"{folder}/{path}"))
    broken[20] ^= 1
    fs.pipe_file(f"{folder}/{path}", bytes(broken))


def test_a_byte_that_is_another_is_repaired_by_a_push_that_verifies(root: Path, url: str, tmp_path: Path) -> None:
    push(root, StoreDataset(url))
    for path in (DATA, layout.STATS, layout.INFO):
        flip(url, path)
        assert push(root, StoreDataset(url)).sent == []  # by the list all is well
        report = push(root, StoreDataset(url), verify=True)
        assert report.sent == [path]
        assert stored(url) == content(root)
    assert push(root, StoreDataset(url), verify=True).sent == []
    pull(StoreDataset(url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


def test_verifying_finds_what_is_there_without_a_list_and_writes_one(root: Path, near_url: str) -> None:
    push(root, StoreDataset(near_url))
    fs, folder = fsspec.core.url_to_fs(near_url)
    fs.rm_file(f"{folder}/{MANIFEST}")
    flip(near_url, DATA)
    assert push(root, StoreDataset(near_url), verify=True).sent == [DATA]
    assert push(root, StoreDataset(near_url)).sent == []
    assert stored(near_url) == content(root)
    fs.rm_file(f"{folder}/{MANIFEST}")
    assert push(root, StoreDataset(near_url), verify=True).sent == []
    assert push(root, StoreDataset(near_url)).sent == []  # what was read is noted, and not sent for want of a note


def test_a_pull_that_verifies_reports_a_damaged_place(root: Path, url: str, tmp_path: Path) -> None:
    push(root, StoreDataset(url))
    pull(StoreDataset(url), tmp_path / "e")
    flip(url, DATA)
    assert pull(StoreDataset(url), tmp_path / "e").fetched == []
    with pytest.raises(TransferError, match=rf"damaged.*{DATA}.*Push the dataset again with --verify"):
        pull(StoreDataset(url), tmp_path / "e", verify=True)
    assert content(tmp_path / "e") == content(root)
    push(root, StoreDataset(url), verify=True)
    report = pull(StoreDataset(url), tmp_path / "e", verify=True)
    assert (report.fetched, report.by_size) == ([], 0)


def test_without_a_list_sizes_are_compared_and_that_is_reported(root: Path, near_url: str, tmp_path: Path) -> None:
    push(root, StoreDataset(near_url))
    fs, folder = fsspec.core.url_to_fs(near_url)
    fs.rm_file(f"{folder}/{MANIFEST}")
    target = tmp_path / "e"
    assert pull(StoreDataset(near_url), target).by_size == 0  # all of it was fetched
    before = content(target)
    flip(near_url, layout.STATS)
    report = pull(StoreDataset(near_url), target)
    assert (report.fetched, report.by_size) == ([], len(content(root)))
    with pytest.raises(DatasetExistsError, match=layout.STATS):
        pull(StoreDataset(near_url), target, verify=True)
    assert content(target) == before
    report = pull(StoreDataset(near_url), target, verify=True, replace=True)
    assert (report.fetched, report.by_size) == ([layout.STATS], 0)
    assert content(target) == stored(near_url) != before


def test_an_info_that_was_damaged_is_not_put_back(root: Path, near_url: str) -> None:
    """A push that takes it away for a while puts its own there, also where that is unchanged."""
    push(root, StoreDataset(near_url))
    flip(near_url, layout.INFO)
    (root / layout.STATS).write_bytes((root / layout.STATS).read_bytes() + b"\n")
    push(root, StoreDataset(near_url))
    assert stored(near_url) == content(root)


@pytest.mark.parametrize("place", ["", "there/d/"])
def test_the_folders_of_a_console_are_no_files(
    root: Path, s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """An S3 console makes a folder by an empty object whose name ends in a slash."""
    use_s3(s3_url, monkeypatch)
    s3 = fsspec.filesystem("s3")
    bucket = f"consoles{len(place)}"
    s3.mkdir(bucket)
    markers = [f"{place}data/", f"{place}data/chunk-000/", f"{place}meta/", *([place] if place else [])]
    for key in markers:
        s3.call_s3("put_object", Bucket=bucket, Key=key, Body=b"")
    url = f"s3://{bucket}/{place}"
    with pytest.raises(TransferError, match=r"no meta/info\.json"):
        pull(StoreDataset(url), tmp_path / "e")
    push(root, StoreDataset(url))
    assert set(StoreDataset(url).files()) == set(content(root))
    pull(StoreDataset(url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)
    assert push(root, StoreDataset(url), verify=True).sent == []
    s3.invalidate_cache()
    found = s3.call_s3("list_objects_v2", Bucket=bucket)["Contents"]
    assert {one["Key"] for one in found} >= set(markers)


def test_a_snapshot_by_hard_links_stays_as_it_was(root: Path, tmp_path: Path) -> None:
    """`cp -al` costs nothing, and is what backups of folders do."""
    shelf, snapshot = tmp_path / "shelf", tmp_path / "snapshot"
    push(root, StoreDataset(f"file://{shelf}"))
    shutil.copytree(shelf, snapshot, copy_function=os.link)
    before = content(snapshot)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    push(root, StoreDataset(f"file://{shelf}"))
    assert content(snapshot) == before
    assert stored(f"file://{shelf}") == content(root)
    assert {name for name in content(shelf) if name.startswith(".")} == set()


def test_what_a_kill_leaves_below_a_folder_is_no_part_of_the_dataset(root: Path, tmp_path: Path, monkeypatch) -> None:
    shelf = tmp_path / "shelf"
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", _killed)
        patch.setattr(Path, "unlink", lambda path, missing_ok=False: None)  # a kill leaves no time to clean up
        with pytest.raises(KeyboardInterrupt):
            push(root, StoreDataset(f"file://{shelf}"))
    assert any(name.endswith(".bhd-part") for name in content(shelf))
    push(root, StoreDataset(f"file://{shelf}"))
    pull(StoreDataset(f"file://{shelf}"), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


def _killed(*_: object) -> None:
    raise KeyboardInterrupt
