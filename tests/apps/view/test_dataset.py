"""Datasets behind the page that change, are odd, damaged or in use."""

import shutil
from contextlib import closing
from pathlib import Path

import pytest

from bhd_lerobot.apps.view.dataset import ViewedDataset
from bhd_lerobot.apps.view.guard import TOKEN_HEADER
from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, DatasetLockedError
from tests.apps.view.support import served
from tests.datasets.loader.support import FRONT, record_ours


def test_a_dataset_that_changes_is_noticed_and_read_again(tmp_path) -> None:
    root = record_ours(tmp_path / "d", 2)
    with served(root) as server:
        assert (found := server.json("/api/stamp"))["now"] == found["shown"]
        shutil.rmtree(root)
        assert server.json("/api/stamp")["now"] == ""
        status, _, content = server.ask("/api/dataset")
        assert status == 409
        assert "does not exist" in content.decode()
        record_ours(root, 3)
        assert (found := server.json("/api/stamp"))["now"] != found["shown"]
        # An episode may have another number now: what the page shows is neither filled in with it nor marked.
        status, _, content = server.ask("/api/episodes/0")
        assert status == 409
        assert "has changed on disk" in content.decode()
        status, content = server.mark(0, {"outcome": "success"})
        assert status == 409
        assert "has changed on disk" in content.decode()
        assert len(server.json("/api/dataset")["episodes"]["frames"]) == 3
        with closing(RootLock(root)):
            status, content = server.mark(0, {"outcome": "success"})
        assert status == 409
        assert "being recorded, repaired, edited" in content.decode()


def test_a_page_that_shows_what_another_page_has_loaded_again_is_refused(tmp_path) -> None:
    """Its numbers are those of other episodes."""
    root = record_ours(tmp_path / "d", 3)
    with served(root) as server:
        old = server.json("/api/dataset")["stamp"]
        delete(root, [0])
        new = server.json("/api/dataset")["stamp"]
        mark = {"method": "POST", "body": {"outcome": "success"}, "headers": {TOKEN_HEADER: server.token()}}
        for path, more in (("", {}), ("/episode.csv", {}), ("/mark", mark)):
            status, _, content = server.ask(f"/api/episodes/0{path}?stamp={old}", **more)
            assert (status, b"has changed on disk" in content) == (409, True), path
            assert server.ask(f"/api/episodes/0{path}?stamp={new}", **more)[0] == 200, path


def test_damaged_missing_and_locked_datasets_are_refused(base, tmp_path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        ViewedDataset(tmp_path / "none")
    with closing(RootLock(base)), pytest.raises(DatasetLockedError, match="being recorded, repaired, edited"):
        ViewedDataset(base)
    root = Path(shutil.copytree(base, tmp_path / "d"))
    path = next((root / "data").rglob("*.parquet"))
    path.unlink()
    with pytest.raises(DatasetCorruptError, match=path.name):
        ViewedDataset(root)


@pytest.mark.parametrize("at_once", [True, False])
def test_a_video_that_is_not_there_is_missing_and_nothing_else_is(base, tmp_path, at_once: bool) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    video = next(root.rglob("*.mp4"))
    if at_once:
        video.unlink()
    with served(root) as server:
        video.unlink(missing_ok=True)
        assert server.ask(f"/videos/{FRONT}/0/0.mp4")[0] == 404
        assert server.ask("/api/episodes/0")[0] == 200
        path = next((root / "data").rglob("*.parquet"))
        path.write_bytes(path.read_bytes()[:-9])
        status, _, content = server.ask("/api/episodes/1")
        assert status == 409
        assert path.name in content.decode()
