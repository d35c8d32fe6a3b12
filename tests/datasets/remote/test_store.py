"""Datasets below a URL: in memory, in a folder, and in an S3-compatible store on this machine."""

import contextlib
import os
import shutil
from pathlib import Path

import fsspec
import pytest

from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import ConfigError, DatasetExistsError, TransferError
from tests.datasets import support
from tests.datasets.edit_support import record
from tests.datasets.foreign import edit_json
from tests.datasets.remote.store_fixtures import KEYS, stored, use_s3
from tests.datasets.support import snapshot as content


@pytest.fixture
def root(video_episodes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(video_episodes, tmp_path / "d"))


def test_what_is_no_later_version_replaces_nothing(root: Path, near_url: str, tmp_path: Path) -> None:
    """A store keeps no history."""
    url, shorter = near_url, Path(shutil.copytree(root, tmp_path / "shorter"))
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    push(root, StoreDataset(url))
    with support.create(tmp_path / "small") as recorder:
        support.record(recorder)
    before = stored(url)
    with pytest.raises(DatasetExistsError, match=r"has 4 episodes, .* has 3: it is an older one"):
        push(shorter, StoreDataset(url))
    with pytest.raises(DatasetExistsError, match=r"is another dataset.*--replace"):
        push(tmp_path / "small", StoreDataset(url))
    assert stored(url) == before
    assert push(tmp_path / "small", StoreDataset(url), replace=True).deleted
    assert stored(url) == content(tmp_path / "small")


def test_another_recording_with_the_same_options_replaces_nothing(near_url: str, tmp_path: Path) -> None:
    """The same command records other episodes of a real robot; what computes statistics anew makes no other one."""
    one, other = record(tmp_path / "one", [0, 1, 2]), record(tmp_path / "other", [0, 4, 5])
    push(one, StoreDataset(near_url))
    before = stored(near_url)
    with pytest.raises(DatasetExistsError, match=r"with the same options: episode 1 has other frames there.*--replace"):
        push(other, StoreDataset(near_url))
    assert stored(near_url) == before
    (one / layout.STATS).unlink()
    fix(one, check_dataset(one).findings)
    push(one, StoreDataset(near_url))
    assert push(other, StoreDataset(near_url), replace=True).episodes == 3


def test_another_recording_and_what_was_marked_there_are_not_overwritten(
    root: Path, near_url: str, tmp_path: Path
) -> None:
    """As many episodes with the same columns do not make it a later version; what only one of both states may."""
    url, other, marked = near_url, tmp_path / "other", tmp_path / "marked"
    for copy in (other, marked):
        shutil.copytree(root, copy)
    push(root, StoreDataset(url))
    before = stored(url)
    edit_json(other / layout.IDENTITY, lambda identity: identity["recording"].update(seed=2))
    with pytest.raises(DatasetExistsError, match=r"is another recording than .*: seed: there 1, here 2\..*--replace"):
        push(other, StoreDataset(url))
    assert stored(url) == before
    mark(marked, [0], outcome="failure")
    push(marked, StoreDataset(url))
    before = stored(url)
    with pytest.raises(DatasetExistsError, match=r"was edited or marked, and .* was not: .*mark.*--replace"):
        push(root, StoreDataset(url))
    assert stored(url) == before
    push(marked, StoreDataset(url))
    merge([marked, other], tmp_path / "both")
    assert push(tmp_path / "both", StoreDataset(url)).episodes == 3


class Dying:
    """Lets a file system's calls through, until one fails."""

    def __init__(self, calls: int) -> None:
        self.left = calls

    def wrap(self, original):
        def call(*args: object, **kwargs: object) -> object:
            if self.left == 0:
                raise ConnectionResetError("gone")
            self.left -= 1
            return original(*args, **kwargs)

        return call


def test_an_upload_that_dies_anywhere_shows_no_part(root: Path, tmp_path: Path, monkeypatch) -> None:
    """At every write: a reader finds the one dataset, the other, or none, and the repetition sends all."""
    memory = fsspec.filesystem("memory")
    old, url, found = tmp_path / "old", "memory://b/d", []
    with support.create(old) as recorder:
        support.record(recorder)
    for step in range(30):
        memory.store.clear()
        push(old, StoreDataset(url))
        dying = Dying(step)
        with monkeypatch.context() as patch, contextlib.suppress(TransferError):
            for name in ("put_file", "pipe_file", "rm_file"):
                patch.setattr(type(memory), name, dying.wrap(getattr(type(memory), name)))
            push(root, StoreDataset(url), replace=True)
        target = tmp_path / f"e{step}"
        if layout.INFO in StoreDataset(url).files():
            pull(StoreDataset(url), target)
            found.append([old, root][[content(old), content(root)].index(content(target))].name)
        else:
            with pytest.raises(TransferError, match=r"no meta/info\.json"):
                pull(StoreDataset(url), target)
            assert not target.exists()
            found.append("none")
        push(root, StoreDataset(url), replace=True)
        assert stored(url) == content(root), step
        if dying.left:
            break
    assert found == ["old", *["none"] * (len(found) - 3), *["d"] * 2]


@pytest.mark.law
def test_a_download_that_dies_leaves_nothing(root: Path, near_url: str, tmp_path: Path, monkeypatch) -> None:
    push(root, StoreDataset(near_url))
    source = StoreDataset(near_url)
    with monkeypatch.context() as patch:
        patch.setattr(source._fs, "get_file", Dying(4).wrap(source._fs.get_file))
        with pytest.raises(TransferError, match="cannot be reached"):
            pull(source, tmp_path / "e")
    assert not {one.name for one in tmp_path.iterdir()} & {"e", ".e.pull"}
    pull(StoreDataset(near_url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


def test_places_that_do_not_exist(root: Path, s3_url: str, tmp_path: Path, monkeypatch) -> None:
    use_s3(s3_url, monkeypatch)
    with pytest.raises(TransferError, match="bucket must be made first"):
        push(root, StoreDataset("s3://nobucket/d"))
    for url in ("s3://nobucket/d", f"file://{tmp_path}/nowhere", "memory://nowhere/d"):
        with pytest.raises(TransferError, match="no LeRobot dataset"):
            pull(StoreDataset(url), tmp_path / "e")


def test_no_store_and_no_credentials(root: Path, monkeypatch) -> None:
    use_s3("http://127.0.0.1:9", monkeypatch)
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr("asyncio.sleep", _no_sleep)
    with pytest.raises(TransferError, match="cannot be reached"):
        push(root, StoreDataset("s3://bucket/d"))
    for name in KEYS:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_CONFIG_FILE", "/dev/null")
    fsspec.filesystem("s3").clear_instance_cache()
    with pytest.raises(TransferError, match="no credentials were found"):
        push(root, StoreDataset("s3://bucket/d"))


def test_a_dataset_is_not_copied_onto_itself(root: Path, tmp_path: Path) -> None:
    before = content(root)
    link = tmp_path / "link"
    link.symlink_to(root)
    for folder in (root, root / "meta", root.parent, link, link / "new"):
        with pytest.raises(ConfigError, match="the same folder"):
            push(root, StoreDataset(f"file://{folder}"))
    for target in (root, link, root / "copy"):
        with pytest.raises(ConfigError, match="the same folder"):
            pull(StoreDataset(f"file://{root}"), target, replace=True)
    assert content(root) == before


def test_what_is_not_installed_is_named(monkeypatch) -> None:
    def missing(*_: object, **__: object) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr("fsspec.core.url_to_fs", missing)
    with pytest.raises(TransferError, match=r"not installed: Install s3fs to access S3"):
        StoreDataset("s3://bucket/d")


async def _no_sleep(*_: object) -> None:
    return None


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_names_are_no_patterns(root: Path, near_url: str, tmp_path: Path, kind: str) -> None:
    """What is removed below one name must not be removed below those that the name would fit as a pattern."""
    place = near_url if kind == "memory" else f"file://{tmp_path}"
    plain = f"{place}/runa/d"
    push(root, StoreDataset(plain))
    before = stored(plain)
    for name in ("run[a]", "run?", "r*"):
        odd = f"{place}/{name}/d"
        push(root, StoreDataset(odd))
        with fsspec.open(f"{odd}/data/chunk-000/file-009.parquet", "wb") as file:
            file.write(b"stale")
        assert push(root, StoreDataset(odd)).deleted == ["data/chunk-000/file-009.parquet"]
        assert stored(plain) == before
        assert stored(odd) == content(root)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("place", ["there/d/", ""])
def test_the_folders_of_a_console_are_no_files(root, s3_url, tmp_path, monkeypatch, place):
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


@pytest.mark.parametrize("changed", [layout.STATS, layout.INFO])
def test_what_is_written_there_during_a_pull_is_noticed(root, near_url, tmp_path, monkeypatch, changed):
    push(root, StoreDataset(near_url))
    source = StoreDataset(near_url)
    get = source._fs.get_file

    def get_and_change(*args: object, **kwargs: object) -> object:
        found = get(*args, **kwargs)
        with fsspec.open(f"{near_url}/{changed}", "wb") as file:
            file.write((root / changed).read_bytes())
        return found

    with monkeypatch.context() as patch:
        patch.setattr(source._fs, "get_file", get_and_change)
        with pytest.raises(TransferError, match=rf"was changed while it was read: {changed}"):
            pull(source, tmp_path / "e")
    assert not (tmp_path / "e").exists()


def test_what_did_not_arrive_whole_stays_invisible(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = StoreDataset("memory://b/short")
    with monkeypatch.context() as patch:
        patch.setattr(store._fs, "put_file", lambda path, target, **_: store._fs.pipe_file(target, b"short"))
        with pytest.raises(TransferError, match="lacks files that were sent"):
            push(root, store)
    assert layout.INFO not in StoreDataset("memory://b/short").files()
