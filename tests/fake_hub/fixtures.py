"""Fixtures around the Hub of the tests."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.push import PushReport, push
from bhd_lerobot.datasets.storage import layout
from tests.datasets.edit_support import record
from tests.fake_hub.hub import FakeHub, real_client

EPISODES = 6


@pytest.fixture
def hub() -> Iterator[FakeHub]:
    """An empty Hub, to which the real client speaks."""
    made = FakeHub()
    with real_client(made):
        yield made


@pytest.fixture(scope="session")
def many_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of `EPISODES` episodes in several data and video files; copy it before it is changed."""
    root = tmp_path_factory.mktemp("many_files") / "d"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "DATA_FILES_SIZE_IN_MB", 0.005)
        patch.setattr(layout, "VIDEO_FILES_SIZE_IN_MB", 0.002)
        record(root, list(range(EPISODES)), video=True)
    assert len(list((root / "data").rglob("*.parquet"))) > 1
    return root


@pytest.fixture
def root(many_files: Path, tmp_path: Path) -> Path:
    """A copy of that dataset, which may be changed: `d` in the test's own folder."""
    return Path(shutil.copytree(many_files, tmp_path / "d"))


def send(root: Path, branch: str | None = None, **options: Any) -> PushReport:
    """Push a dataset to the place that the tests use."""
    return push(root, HubDataset("me/d", branch, create=True), **options)


def stored(hub: FakeHub, revision: str = "main") -> dict[str, bytes]:
    """Return every file there but the one that the Hub makes."""
    files = hub.dataset("me/d").files(revision)
    return {path: blob.content for path, blob in files.items() if path != ".gitattributes"}
