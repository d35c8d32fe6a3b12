"""Fixtures around places below a URL."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import fsspec
import pytest

from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.store import StoreDataset
from tests.fake_hub.fixtures import stored as stored_on
from tests.fake_hub.hub import FakeHub

KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="session")
def s3_url() -> Iterator[str]:
    """An S3-compatible store with one bucket; yields its address."""
    from moto import backends
    from moto.server import ThreadedMotoServer

    services = list(backends.list_of_moto_modules())
    server = ThreadedMotoServer(port=0)
    with pytest.MonkeyPatch.context() as patch:
        # It would look for all of them on the disk at every request, which takes longer than the request.
        patch.setattr(backends, "list_of_moto_modules", lambda: services)
        server.start()
        host, port = server.get_host_and_port()
        yield f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}"
        server.stop()


@pytest.fixture
def near_url() -> str:
    """A place that needs no server: for what happens on our side of the store, whichever it is."""
    fsspec.filesystem("memory").store.clear()
    return "memory://bucket/there/d"


@dataclass(frozen=True)
class Place:
    """A place of any kind: a URL, or `me/d` on a Hub."""

    url: str
    hub: FakeHub | None = None

    def remote(self) -> HubDataset | StoreDataset:
        return StoreDataset(self.url) if self.hub is None else HubDataset(self.url, create=True)

    def stored(self) -> dict[str, bytes]:
        return stored(self.url) if self.hub is None else stored_on(self.hub)


@pytest.fixture(params=["hub", "memory", "file", "s3"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A place of each kind."""
    if request.param == "hub":
        return Place("me/d", request.getfixturevalue("hub"))
    if request.param == "memory":
        return Place(request.getfixturevalue("near_url"))
    if request.param == "file":
        return Place(f"file://{tmp_path}/there/d")
    use_s3(request.getfixturevalue("s3_url"), monkeypatch)
    s3 = fsspec.filesystem("s3")
    if s3.exists("bucket"):
        s3.rm("bucket", recursive=True)
    s3.mkdir("bucket")
    return Place("s3://bucket/there/d")


def use_s3(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": address}.items():
        monkeypatch.setenv(name, value)
    fsspec.filesystem("s3").clear_instance_cache()


def stored(url: str) -> dict[str, bytes]:
    store = StoreDataset(url)
    return {path: store.read(path) or b"" for path in store.files()}
