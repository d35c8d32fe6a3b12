"""A dataset names no file outside of it: neither by a link nor by a name that becomes a path."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.datasets.edit.edits import keep, merge, split
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.loader.table import open_metadata
from bhd_lerobot.datasets.recovery.columns import read_info
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.remote.listing import RemoteFile, parse_info
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.places import (
    LINKED_FOLDERS,
    check_inside,
    check_links,
    wrong_info,
    wrong_name,
    wrong_path,
)
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import BhdError, DatasetError
from tests.datasets import support
from tests.datasets.edit_support import content

ESCAPES = ("../../../../x", "..", ".", "", "/x", "a/b", "a\\b", "a\0b", "a\nb", "\ud800", "x" * 300)
PARTS = st.sampled_from(["..", ".", "/", "\\", "a", "videos", "\0", "\n", "", "ä", " ", "~", "$HOME", "{", "\ud800"])
NAMES = st.lists(PARTS, max_size=6).map("".join) | st.text(max_size=8)


@pytest.fixture
def root(video_episodes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(video_episodes, tmp_path / "d"))


@settings(max_examples=50)
@given(NAMES)
def test_a_valid_name_is_one_part_of_a_path(name: str) -> None:
    whole = Path("/d/videos")
    if not wrong_name(name):
        name.encode()
        assert os.path.normpath(whole / name) == f"{whole}/{name}"
        assert wrong_path(f"videos/{name}/file") == ""
        assert wrong_info({"features": {name: {}}}) == ""
    else:
        assert wrong_path(f"videos/{name}/file") or "/" in name
        assert name in ("", ".", "..") or not name.isprintable() or "/" in name or "\\" in name
        assert wrong_info({"features": {name: {}}})


@given(st.lists(PARTS | st.sampled_from(["{chunk_index:03d}", "{file_index}", "{x.y}", "{x[0]}", "{}"])).map("/".join))
def test_a_valid_template_stays_inside(template: str) -> None:
    if not wrong_info({"data_path": template}):
        path = template.format(chunk_index=1, file_index=2)
        assert os.path.normpath(Path("/d") / path).startswith("/d/")


def test_all_readers_refuse_names_that_lead_outside(root: Path, tmp_path: Path) -> None:
    camera = support.CAMERA
    outside = tmp_path / "victim"
    outside.mkdir()
    info = json.loads((root / layout.INFO).read_text())
    readers: list[Callable[[], Any]] = [
        lambda: load_state(root),
        lambda: keep(root, [0], tmp_path / "work" / "kept"),
        lambda: split(root, {"a": [0]}, tmp_path / "work" / "parts"),
        lambda: merge([root, root], tmp_path / "work" / "merged"),
        lambda: repair(root),
        lambda: check_dataset(root),
        lambda: open_metadata(root),
        lambda: local_metadata("t/t", root),
        lambda: read_info(root / layout.INFO),
        lambda: parse_info((root / layout.INFO).read_bytes(), "there"),
    ]
    before = {path for path in tmp_path.rglob("*") if root not in path.parents}
    for name in ESCAPES:
        features = {name if key == camera else key: one for key, one in info["features"].items()}
        changed: list[dict[str, Any]] = [{**info, "features": features}]
        if name and "/" in name:
            changed += [{**info, "data_path": f"data/{name}/{{file_index}}.parquet"}] * (".." in name)
            changed.append({**info, "video_path": f"/{name}"})
        for one in changed:
            (root / layout.INFO).write_text(json.dumps(one))
            for reader in readers:
                with pytest.raises(BhdError):
                    reader()
            assert {path for path in tmp_path.rglob("*") if root not in path.parents} <= before | {tmp_path / "work"}
        with pytest.raises(BhdError, match="name"):  # as an exported bag may say it
            DatasetRecorder.create("t/t", 10, features, robot_type="t", root=tmp_path / "new")


class Listing:
    """A remote place that lists what a stranger wants."""

    name, folder, has_checksums = "there", None, True

    def __init__(self, paths: list[str]) -> None:
        self._paths = paths

    def files(self) -> dict[str, RemoteFile]:
        return {path: RemoteFile(1) for path in (layout.INFO, *self._paths)}


def test_file_names_of_a_remote_place_are_checked(tmp_path: Path) -> None:
    for path in ("/etc/x", "../x", "data/../../x", "data//x", "a\\..\\x", "data/\0", "./x", "data/."):
        with pytest.raises(BhdError, match="no path within the dataset"):
            pull(Listing([path]), tmp_path / "d")  # type: ignore[arg-type]
        assert not any(tmp_path.iterdir())


def test_a_pull_refuses_a_staging_folder_of_another_user(tmp_path: Path) -> None:
    """In a folder that is everybody's, as /tmp, its name can be foreseen, and what is in it could change later."""
    staging = tmp_path / ".d.pull"
    staging.mkdir()
    (staging / "thesis.txt").write_text("years")  # of this user, but of no pull
    with pytest.raises(DatasetError, match=r"\.d\.pull is in the way"):
        pull(Listing([]), tmp_path / "d")  # type: ignore[arg-type]
    (staging / "thesis.txt").unlink()
    staging.rmdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / ".bhd-pull").touch()
    staging.symlink_to("elsewhere")
    with pytest.raises(DatasetError, match=r"\.d\.pull is in the way"):
        pull(Listing([]), tmp_path / "d")  # type: ignore[arg-type]
    staging.unlink()
    if not os.geteuid():
        (tmp_path / "elsewhere").rename(staging)
        os.chown(staging, 65534, -1)
        with pytest.raises(DatasetError, match=r"\.d\.pull is in the way"):
            pull(Listing([]), tmp_path / "d")  # type: ignore[arg-type]


@pytest.mark.law
def test_no_command_follows_a_link_out_of_the_dataset(root: Path, tmp_path: Path) -> None:
    data, video = "data/chunk-000/file-000.parquet", layout.video_file(support.CAMERA, (0, 0))
    episodes = "meta/episodes/chunk-000/file-000.parquet"
    others = ("images", "tmp123", "meta/notes.txt", "videos/x", "data/chunk-000/.hidden")
    for name in (data, video, episodes, layout.INFO, layout.TASKS, layout.STATS, "videos", "data/chunk-000", *others):
        place, secret = root / name, tmp_path / "secret"
        if place.exists():
            place.rename(secret)
        else:
            secret.write_text("password")
        (root / ".step").symlink_to(secret)
        place.symlink_to(root / ".step")  # by way of a link that stays inside
        calls: list[Callable[[], Any]] = [
            lambda: load_state(root),
            lambda: load_state(root, videos=False),
            lambda: keep(root, [0], tmp_path / "kept"),
            lambda: repair(root),
            lambda: push(root, StoreDataset("memory://links/d")),
        ]
        for call in calls:
            with pytest.raises(DatasetError, match=r"is a link to .*secret, outside of the dataset.*cp -rL") as caught:
                call()
            assert str(place) in str(caught.value)
            assert LINKED_FOLDERS in str(caught.value)
        assert not (tmp_path / "kept").exists()
        if name not in (layout.INFO, "data/chunk-000"):
            found = [str(finding) for finding in check_dataset(root).findings]
            assert any("link leads out of the dataset" in one for one in found)
        place.unlink()
        (root / ".step").unlink()
        if name in others:
            secret.unlink()
        else:
            secret.rename(place)
    load_state(root)


def test_links_within_and_to_declared_places(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = content(root)
    (root / "videos").rename(root / "media")
    (root / "videos").symlink_to("media")
    (root / "data" / "again").symlink_to("..")  # a circle
    (root / "meta" / "itself").symlink_to("itself")
    load_state(root)
    (root / "media").rename(tmp_path / "big")
    (root / "videos").unlink()
    (root / "videos").symlink_to(tmp_path / "big")
    with pytest.raises(DatasetError, match="outside of the dataset"):
        load_state(root)
    monkeypatch.setenv(LINKED_FOLDERS, f"/nowhere:{tmp_path / 'big'}")
    load_state(root)
    (root / "data" / "again").unlink()
    (root / "meta" / "itself").unlink()
    assert content(root) == wanted
    link = tmp_path / "link"
    link.symlink_to(root)  # the folder itself may be one
    load_state(link)


def test_a_folder_that_only_looks_like_a_cache(root: Path, tmp_path: Path) -> None:
    """Folders named as the Hub's cache lead nowhere else by a link of their own."""
    repository = tmp_path / "datasets--me--d"
    snapshot = repository / "snapshots" / "abc"
    snapshot.parent.mkdir(parents=True)
    root.rename(snapshot)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "key").write_text("password")
    (repository / "blobs").symlink_to(tmp_path / "home")
    (snapshot / "meta" / "x").symlink_to("../../../blobs/key")
    with pytest.raises(DatasetError, match=r"is a link to .*home/key"):
        check_links(snapshot)
    (repository / "blobs").unlink()
    (repository / "blobs").mkdir()
    (repository / "blobs" / "key").write_text("of the dataset")
    check_links(snapshot)


def test_images_beside_the_data_are_within(root: Path) -> None:
    for path in ("/etc/passwd", "../x", "images/../../x"):
        with pytest.raises(DatasetError, match="outside of the dataset"):
            check_inside(root, root / path)
    with pytest.raises(DatasetError, match="no file can be called"):
        check_inside(root, root / "a\0b")
    assert check_inside(root, root / "images/x.png") == root.resolve() / "images/x.png"


@pytest.mark.parametrize("chunks_size", [1, 2, 1000, 5000])
def test_files_are_numbered_in_the_order_of_their_names(chunks_size: int) -> None:
    slot, names = None, []
    for _ in range(2500 if chunks_size > 900 else 900):
        slot = layout.next_slot(slot, chunks_size)
        names.append(layout.data_file(slot))
    assert names == sorted(set(names))
