"""Fixtures around the Hub of the tests; a test module takes them by `pytest_plugins`."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.push import PushReport, push
from bhd_lerobot.datasets.storage import layout
from tests.datasets import support
from tests.hub_server.client import real_client
from tests.hub_server.server import HubServer

EPISODES = 6


@pytest.fixture(scope="session")
def running_hub() -> Iterator[HubServer]:
    """One server for all tests, with what they left there."""
    with HubServer() as one:
        yield one


@pytest.fixture
def hub(running_hub: HubServer) -> Iterator[HubServer]:
    """An empty server, to which the real client is pointed; the client does not wait before it tries again."""
    running_hub.reset()
    running_hub.repositories.clear()
    with real_client(running_hub) as patch:
        # In the client alone: the tests themselves do wait.
        hasty = SimpleNamespace(**{**vars(time), "sleep": lambda seconds: None})
        for module in ("utils._http", "file_download"):
            patch.setattr(f"huggingface_hub.{module}.time", hasty)
        yield running_hub


@pytest.fixture(scope="session")
def many_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of `EPISODES` episodes in several data and video files; copy it before it is changed."""
    root = tmp_path_factory.mktemp("many_files") / "d"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "DATA_FILES_SIZE_IN_MB", 0.005)
        patch.setattr(layout, "VIDEO_FILES_SIZE_IN_MB", 0.002)
        with support.create(root, video=True) as recorder:
            for _ in range(EPISODES):
                support.record(recorder, video=True)
    assert len(list((root / "data").rglob("*.parquet"))) > 1
    return root


@pytest.fixture
def root(many_files: Path, tmp_path: Path) -> Path:
    """A copy of that dataset, which may be changed: `d` in the test's own folder."""
    return Path(shutil.copytree(many_files, tmp_path / "d"))


def send(root: Path, branch: str | None = None, **options: Any) -> PushReport:
    """Push a dataset to the place that the tests use."""
    return push(root, HubDataset("me/d", branch, create=True), **options)


def stored(hub: HubServer, revision: str = "main") -> dict[str, bytes]:
    """Return every file there but the one that the Hub makes."""
    files = hub.dataset("me/d").files(revision)
    return {path: blob.content for path, blob in files.items() if path != ".gitattributes"}
