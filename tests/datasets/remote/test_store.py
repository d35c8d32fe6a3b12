"""Datasets below a URL: in memory, in a folder, and in an S3-compatible store on this machine."""

import contextlib
import json
import shutil
from pathlib import Path

import fsspec
import pytest

from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.remote import store as remote_store
from bhd_lerobot.datasets.remote.listing import MANIFEST
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.remote.subset import subset_episodes
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError, TransferError
from tests.datasets import support
from tests.datasets.remote.store_fixtures import KEYS, stored, use_s3
from tests.hub_server.fixtures import content

pytest_plugins = ["tests.datasets.remote.store_fixtures", "tests.hub_server.fixtures"]


@pytest.fixture
def root(few_files: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(few_files, tmp_path / "d"))


def test_what_comes_back_is_what_was_recorded(root: Path, url: str, tmp_path: Path) -> None:
    report = push(root, StoreDataset(url))
    assert stored(url) == content(root)
    assert len(report.sent) == len(content(root))
    pull(StoreDataset(url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)
    assert (push(root, StoreDataset(url)).sent, pull(StoreDataset(url), tmp_path / "e").fetched) == ([], [])


def test_a_longer_dataset_replaces_what_differs(root: Path, url: str, tmp_path: Path) -> None:
    push(root, StoreDataset(url))
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    report = push(root, StoreDataset(url))
    assert stored(url) == content(root)
    assert report.kept > 0
    with support.create(tmp_path / "small") as recorder:
        support.record(recorder)
    before = stored(url)
    with pytest.raises(DatasetExistsError, match=r"is another dataset.*--replace"):
        push(tmp_path / "small", StoreDataset(url))
    assert stored(url) == before
    assert push(tmp_path / "small", StoreDataset(url), replace=True).deleted
    assert stored(url) == content(tmp_path / "small")


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


def test_an_upload_that_dies_anywhere_shows_no_part_and_goes_on(root: Path, tmp_path: Path, monkeypatch) -> None:
    """At every write: a reader finds the one dataset, the other, or none, and the repetition sends what is missing."""
    monkeypatch.setattr(remote_store, "WORKERS", 1)
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
    assert found == [*["old"] * 2, *["none"] * (len(found) - 5), *["d"] * 3]


def test_what_arrived_is_not_sent_again(root: Path, near_url: str, monkeypatch) -> None:
    monkeypatch.setattr(remote_store, "WORKERS", 1)
    first = StoreDataset(near_url)
    with monkeypatch.context() as patch:
        patch.setattr(first._fs, "put_file", Dying(3).wrap(first._fs.put_file))
        with pytest.raises(TransferError):
            push(root, first)
    report = push(root, StoreDataset(near_url))
    assert report.kept == 3
    assert stored(near_url) == content(root)


def test_a_download_that_dies_leaves_no_dataset_and_goes_on(root: Path, url: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(remote_store, "WORKERS", 1)
    push(root, StoreDataset(url))
    source = StoreDataset(url)
    with monkeypatch.context() as patch:
        patch.setattr(source._fs, "get_file", Dying(4).wrap(source._fs.get_file))
        with pytest.raises(TransferError, match="cannot be reached"):
            pull(source, tmp_path / "e")
    assert not (tmp_path / "e").exists()
    assert len(pull(StoreDataset(url), tmp_path / "e").fetched) == len(content(root)) - 4
    assert content(tmp_path / "e") == content(root)


def test_a_dataset_that_another_program_put_there(root: Path, tmp_path: Path) -> None:
    """Without our list of checksums sizes decide, and a push sends everything once."""
    there = tmp_path / "there"
    shutil.copytree(root, there)
    url = f"file://{there}"
    pull(StoreDataset(url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)
    assert len(push(root, StoreDataset(url)).sent) == len(content(root))
    assert push(root, StoreDataset(url)).sent == []


def test_a_list_that_is_damaged_is_not_trusted(root: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path}/there"
    push(root, StoreDataset(url))
    for text in ("{", "[]", '{"files": {"meta/info.json": 3}}'):
        (tmp_path / "there" / MANIFEST).write_text(text)
        assert len(push(root, StoreDataset(url)).sent) == len(content(root))
    listed = json.loads((tmp_path / "there" / MANIFEST).read_text())["files"]
    assert set(listed) == set(content(root))


def test_a_file_that_would_lie_outside_is_refused(root: Path, tmp_path: Path, monkeypatch) -> None:
    push(root, StoreDataset("memory://b/d"))
    source = StoreDataset("memory://b/d")
    files = source.files()
    monkeypatch.setattr(source, "files", lambda: {**files, "../../evil": files[layout.INFO]})
    with pytest.raises(TransferError, match="is no path within the dataset"):
        pull(source, tmp_path / "e")


def test_some_episodes(many_files: Path, near_url: str, tmp_path: Path) -> None:
    push(many_files, StoreDataset(near_url))
    report = pull(StoreDataset(near_url), tmp_path / "e", select=lambda folder: [1])
    assert (report.episodes, report.is_whole, subset_episodes(tmp_path / "e")) == ([1], False, [1])
    (tmp_path / "e" / layout.STATS).write_text("{}")
    with pytest.raises(DatasetExistsError):
        pull(StoreDataset(near_url), tmp_path / "e")


def test_a_change_during_the_upload_is_not_shown(root: Path, monkeypatch) -> None:
    store = StoreDataset("memory://b/changed")
    put = store._fs.put_file

    def put_and_change(*args: object, **kwargs: object) -> object:
        (root / layout.STATS).write_text("{}")
        return put(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(store._fs, "put_file", put_and_change)
        with pytest.raises(DatasetError, match="changed by another program"):
            push(root, store)
    assert layout.INFO not in StoreDataset("memory://b/changed").files()


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
    with pytest.raises(TransferError, match=r"pip install 's3fs'"):
        StoreDataset("s3://bucket/d")


async def _no_sleep(*_: object) -> None:
    return None


def test_names_are_no_patterns(root: Path, url: str) -> None:
    """What is removed below one name must not be removed below those that the name would fit as a pattern."""
    place = url.rsplit("/", 2)[0]
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


def test_a_file_that_was_cut_or_changed_there_is_refused_and_a_cut_one_sent_again(
    root: Path, url: str, tmp_path: Path
) -> None:
    push(root, StoreDataset(url))
    video = next(name for name in content(root) if name.endswith(".mp4"))
    whole = (root / video).read_bytes()
    for damaged in (whole[:20] + bytes([whole[20] ^ 1]) + whole[21:], whole[:-40]):
        with fsspec.open(f"{url}/{video}", "wb") as file:
            file.write(damaged)
        with pytest.raises(TransferError, match=rf"{Path(video).name} differs"):
            pull(StoreDataset(url), tmp_path / "e")
        assert not (tmp_path / "e").exists()
    assert push(root, StoreDataset(url)).sent == [video]
    pull(StoreDataset(url), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


def test_an_older_copy_does_not_replace_a_longer_one(root: Path, near_url: str, tmp_path: Path) -> None:
    """A store keeps no history; fewer episodes are right only where some were deleted."""
    longer = Path(shutil.copytree(root, tmp_path / "longer"))
    with support.resume(longer, video=True) as recorder:
        support.record(recorder, video=True)
    push(longer, StoreDataset(near_url))
    with pytest.raises(DatasetExistsError, match=r"has 4 episodes, .* has 3 and none was deleted"):
        push(root, StoreDataset(near_url))
    assert stored(near_url) == content(longer)
    delete(longer, [0])
    push(longer, StoreDataset(near_url))
    assert stored(near_url) == content(longer)


def test_an_older_copy_does_not_replace_what_a_push_that_did_not_end_took_away(
    root: Path, near_url: str, tmp_path
) -> None:
    old = Path(shutil.copytree(root, tmp_path / "old"))
    for _ in range(2):
        push(root, StoreDataset(near_url))
        with support.resume(root, video=True) as recorder:
            support.record(recorder, video=True)
    store = StoreDataset(near_url)
    store._put = Dying(0).wrap(store._put)  # type: ignore[method-assign]
    with pytest.raises(TransferError):
        push(root, store)
    assert layout.INFO not in stored(near_url)
    with pytest.raises(DatasetExistsError, match=r"before a push to it that did not end, has 4 episodes.*has 3"):
        push(old, StoreDataset(near_url))
    push(root, StoreDataset(near_url))
    assert stored(near_url) == content(root)


def test_episodes_that_were_deleted_before_the_copy_excuse_nothing(root: Path, tmp_path: Path) -> None:
    longer = tmp_path / "longer"
    with support.create(longer, video=True) as recorder:
        for _ in range(4):
            support.record(recorder, video=True)
    fsspec.filesystem("memory").store.clear()
    delete(root, [0])
    push(root, StoreDataset("memory://b/d"))
    delete(root, [0])
    push(root, StoreDataset("memory://b/d"))  # one fewer, and one was deleted since
    push(longer, StoreDataset("memory://b/d"))
    with pytest.raises(DatasetExistsError, match=r"has 4 episodes, .* has 1 and 2 were deleted from it since"):
        push(root, StoreDataset("memory://b/d"))
    pull(StoreDataset("memory://b/d"), tmp_path / "e")
    assert content(tmp_path / "e") == content(longer)
