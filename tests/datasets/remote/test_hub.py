"""Datasets to a Hub on this machine and back, through the real client: what moves, what shows, what goes wrong."""

import json
from pathlib import Path

import pytest

from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError, TransferError
from tests.datasets import support
from tests.datasets.support import snapshot as content
from tests.fake_hub.fixtures import EPISODES, send, stored
from tests.fake_hub.hub import FakeHub, Fault, real_client


def test_an_interrupted_upload_goes_on_where_it_was(hub: FakeHub, root: Path) -> None:
    hub.faults = [Fault("^PUT", times=-1, after=2, after_bytes=100)]
    with pytest.raises(TransferError, match="connection was lost"):
        send(root)
    arrived = hub.received
    assert arrived > 0
    assert stored(hub) == {}  # nothing of it can be seen
    hub.faults = []
    send(root)
    assert stored(hub) == content(root)
    assert hub.received == sum(len(one) for one in hub.dataset("me/d").objects.values())  # no object came twice


def test_an_interrupted_download_goes_on_where_it_was(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    target = tmp_path / "e"
    hub.reset()
    hub.faults = [Fault("^GET .*/resolve/.*/data/", times=-1, after=1, after_bytes=50)]
    with pytest.raises(TransferError, match="connection was lost"):
        pull(HubDataset("me/d"), target)
    assert not target.exists()  # nothing that looks like a dataset
    arrived = {path for path in content(tmp_path / ".e.pull") if not path.startswith(".")}
    assert layout.INFO in arrived
    hub.reset()
    pull(HubDataset("me/d"), target)
    assert content(target) == content(root)
    again = {line.split("/resolve/")[1].partition("/")[2] for line in hub.asked("^GET .*/resolve/")}
    assert again
    assert not again & arrived


def test_the_reason_why_a_user_may_not_write_is_named(root: Path) -> None:
    before = content(root)
    for token, name, reason in (
        (None, "me/d", "no token"),
        ("read_me", "me/d", "no permission"),
        ("hf_me", "other/d", "no permission"),
        ("nonsense", "me/d", "expired or was revoked"),
    ):
        with real_client(FakeHub(), token), pytest.raises(TransferError, match=reason):
            push(root, HubDataset(name, create=True))
        assert content(root) == before


def test_a_token_that_expires_in_the_middle(hub: FakeHub, root: Path) -> None:
    hub.faults = [Fault("/commit/", status=401)]
    with pytest.raises(TransferError, match="expired or was revoked"):
        send(root)
    send(root)
    assert stored(hub) == content(root)


def test_what_is_not_there_is_named(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    for name, revision, reason in (("me/none", None, "no such repository"), ("me/d", "old", "no revision 'old'")):
        with pytest.raises(TransferError, match=reason):
            pull(HubDataset(name, revision), tmp_path / "e")
        with pytest.raises(DatasetError, match=reason):
            local_metadata(name, tmp_path / "f", revision=revision)
    with pytest.raises(ConfigError, match="a dataset of unknown revision"):
        local_metadata("me/d", root, revision="main")
    hub.dataset("me/d").add("empty", {})
    with pytest.raises(TransferError, match="no LeRobot dataset"):
        pull(HubDataset("me/d", "empty"), tmp_path / "e")
    assert not (tmp_path / "e").exists()


def test_without_network(hub: FakeHub, root: Path, tmp_path: Path, monkeypatch) -> None:
    hub.is_down = True
    with pytest.raises(TransferError, match=r"cannot be reached.*HF_ENDPOINT"):
        send(root)
    with pytest.raises(TransferError, match="cannot be reached"):
        pull(HubDataset("me/d"), tmp_path / "e")
    with pytest.raises(DatasetError, match=r"cannot be reached.*HF_ENDPOINT"):
        local_metadata("me/none", tmp_path / "f", revision="main")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(TransferError, match="HF_HUB_OFFLINE"):
        send(root)


def test_a_private_repository_stays_so(hub: FakeHub, root: Path, tmp_path: Path, monkeypatch) -> None:
    push(root, HubDataset("me/d", create=True, private=True))
    send(root)  # says nothing about it: fine
    with pytest.raises(TransferError, match="is private; public was requested"):
        push(root, HubDataset("me/d", create=True, private=False))
    monkeypatch.setenv("HF_TOKEN", "hf_other")
    with pytest.raises(TransferError, match="no such repository"):
        pull(HubDataset("me/d"), tmp_path / "e")


def test_branches_and_tags(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    first = stored(hub)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    push(root, HubDataset("me/d", "more", create=True, tag="seven"))
    assert stored(hub) == first  # neither main nor its tag moved
    assert stored(hub, "more") == stored(hub, "seven") == content(root)
    assert stored(hub, "v3.0") == first
    for revision, episodes in ((None, 6), ("more", 7), ("seven", 7), (hub.dataset("me/d").tags["v3.0"], 6)):
        assert pull(HubDataset("me/d", revision), tmp_path / f"to_{revision}").total_episodes == episodes
    with pytest.raises(TransferError, match="is a tag"):
        send(root, "seven")


def test_two_pushes_at_once_do_not_mix(hub: FakeHub, root: Path, monkeypatch) -> None:
    send(root)
    remote = HubDataset("me/d", create=True)
    files = remote.files

    def files_then_another() -> object:
        found = files()
        hub.dataset("me/d").add("main", dict(hub.dataset("me/d").files()) | {})
        return found

    monkeypatch.setattr(remote, "files", files_then_another)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    with pytest.raises(TransferError, match="changed by another client"):
        push(root, remote)


def test_loading_by_name_downloads_only_the_wanted_episodes(hub, root, tmp_path, monkeypatch):
    send(root)
    hub.reset()
    recorded = {path for path in content(root) if path.startswith(("data/", "videos/"))}
    meta = local_metadata("me/d", tmp_path / "one", episodes=[0])
    assert meta.total_episodes == EPISODES
    assert set(content(tmp_path / "one")) & recorded == load_state(root).files([0]) & recorded
    local_metadata("me/d", tmp_path / "two", select=lambda found: [EPISODES - 1])
    assert set(content(tmp_path / "two")) & recorded == load_state(root).files([EPISODES - 1]) & recorded


def test_a_tag_of_a_release_does_not_move(hub: FakeHub, root: Path) -> None:
    push(root, HubDataset("me/d", create=True, tag="one"))
    push(root, HubDataset("me/d", create=True, tag="one"))  # the same again
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    with pytest.raises(TransferError, match="has a tag 'one' already"):
        push(root, HubDataset("me/d", create=True, tag="one"))
    assert stored(hub) == stored(hub, "one") != content(root)


def test_files_that_the_repository_ignores_are_named(hub: FakeHub, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import HfApi

    preupload = HfApi.preupload_lfs_files

    def ignoring(self: HfApi, repo_id: str, additions: list, **options: object) -> None:
        preupload(self, repo_id, additions, **options)
        additions[0]._should_ignore = True

    monkeypatch.setattr(HfApi, "preupload_lfs_files", ignoring)
    with pytest.raises(TransferError, match=r"\.gitignore names"):
        send(root)
    assert layout.INFO not in HubDataset("me/d").files()


BROKEN: list[bytes | tuple[str, object]] = [b"[]", b"", ("fps", "ten"), ("codebase_version", 3.0)]


def test_an_info_of_another_shape_is_refused_with_the_reason(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    send(root)
    info = hub.dataset("me/d").files()[layout.INFO]
    whole = info.content
    for number, broken in enumerate(BROKEN):
        info.content = (
            broken if isinstance(broken, bytes) else json.dumps({**json.loads(whole), broken[0]: broken[1]}).encode()
        )
        hub.reset()
        select = (lambda folder: [0]) if number % 2 else None
        with pytest.raises(DatasetError, match=r"me/d (is no LeRobot dataset: .*info\.json|has dataset format 3\.0)"):
            pull(HubDataset("me/d"), tmp_path / "e", select=select)
        assert not hub.asked("GET .*/resolve/.*/data/")
        assert list(tmp_path.iterdir()) == [root]
        with pytest.raises(DatasetExistsError, match=r"me/d .*--replace"):
            send(root)
    send(root, replace=True)
    assert stored(hub) == content(root)
