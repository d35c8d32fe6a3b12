"""Datasets to a Hub on this machine and back, through the real client: what moves, what shows, what goes wrong."""

import shutil
import threading
from pathlib import Path

import pytest

from bhd_lerobot.data import hub as hub_module
from bhd_lerobot.data import layout, remote_pull
from bhd_lerobot.data.card import is_generated, sign
from bhd_lerobot.data.disk import RootLock
from bhd_lerobot.data.hub import HubDataset
from bhd_lerobot.data.remote_pull import pull
from bhd_lerobot.data.remote_push import Card, PushReport, push
from bhd_lerobot.data.remote_subset import files_of
from bhd_lerobot.data.source import local_metadata
from bhd_lerobot.errors import (
    ConfigError,
    DatasetCorruptError,
    DatasetError,
    DatasetExistsError,
    DatasetLockedError,
    DatasetWriteError,
    TransferError,
)
from tests.data import support
from tests.hub_server.client import real_client
from tests.hub_server.fixtures import EPISODES, content
from tests.hub_server.server import Fault, HubServer

pytest_plugins = ["tests.hub_server.fixtures"]


@pytest.fixture
def root(many_files: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(many_files, tmp_path / "d"))


def send(root: Path, branch: str | None = None, **options: object) -> PushReport:
    return push(root, HubDataset("me/d", branch, create=True), **options)  # type: ignore[arg-type]


def stored(hub: HubServer, revision: str = "main") -> dict[str, bytes]:
    files = hub.dataset("me/d").files(revision)
    return {path: blob.content for path, blob in files.items() if path != ".gitattributes"}


def test_what_comes_back_is_what_was_recorded(hub: HubServer, root: Path, tmp_path: Path) -> None:
    report = send(root)
    assert stored(hub) == content(root)
    assert (report.episodes, len(report.sent), report.kept) == (EPISODES, len(content(root)), 0)
    fetched = pull(HubDataset("me/d"), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)
    assert (fetched.episodes, fetched.kept) == (None, 0)
    assert support.verify(tmp_path / "e", EPISODES, video=True, stats=True) == EPISODES
    assert sorted(one.name for one in tmp_path.iterdir()) == ["d", "e"]  # nothing is left beside it


def test_a_push_is_one_commit_with_the_tag_that_lerobot_looks_for(hub: HubServer, root: Path) -> None:
    send(root)
    repository = hub.dataset("me/d")
    assert len(repository.commits) == 2  # the Hub's own first one, and the dataset
    assert repository.tags == {"v3.0": repository.branches["main"]}


def test_a_second_push_and_a_second_pull_move_nothing(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    pull(HubDataset("me/d"), tmp_path / "e")
    hub.reset()
    assert (send(root).sent, pull(HubDataset("me/d"), tmp_path / "e").fetched) == ([], [])
    assert all(one.endswith("/meta/info.json") for one in hub.asked("^PUT|/commit/|/tag/|/resolve/"))
    assert hub.received == 0
    assert hub.sent < 10_000  # meta/info.json, to see whether it is the same dataset


def test_a_longer_dataset_sends_only_what_differs_and_removes_what_is_old(hub: HubServer, root: Path) -> None:
    send(root)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    hub.reset()
    report = send(root)
    assert stored(hub) == content(root)
    assert report.kept > 0
    assert layout.INFO in report.sent
    repository = hub.dataset("me/d")
    assert repository.tags["v3.0"] == repository.branches["main"]


def test_files_that_no_episode_needs_any_more_go(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    with support.create(tmp_path / "small") as recorder:
        support.record(recorder)
    report = send(tmp_path / "small", replace=True)
    assert stored(hub) == content(tmp_path / "small")
    assert any(path.startswith("videos/") for path in report.deleted)


@pytest.mark.parametrize("size", [3, 500])
def test_nobody_sees_a_part_of_a_dataset(hub: HubServer, root: Path, monkeypatch, size: int) -> None:
    """Of several commits only the last brings info.json, and the tag moves after it."""
    monkeypatch.setattr(hub_module, "_COMMIT_SIZE", size)
    send(root)
    commits = list(hub.dataset("me/d").commits.values())
    assert [layout.INFO in files for files in commits] == [False] * (len(commits) - 1) + [True]
    assert stored(hub) == content(root)


def test_an_interrupted_upload_goes_on_where_it_was(hub: HubServer, root: Path) -> None:
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


def test_an_interrupted_download_goes_on_where_it_was(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    target = tmp_path / "e"
    hub.reset()
    hub.faults = [Fault("^GET .*/resolve/.*/data/", times=-1, after=1, after_bytes=50)]
    with pytest.raises(TransferError, match="connection was lost"):
        pull(HubDataset("me/d"), target)
    assert not target.exists()  # nothing that looks like a dataset
    arrived = {path for path in content(tmp_path / ".e.pull") if not path.startswith(".")}
    assert arrived
    hub.reset()
    pull(HubDataset("me/d"), target)
    assert content(target) == content(root)
    again = {line.split("/resolve/")[1].partition("/")[2] for line in hub.asked("^GET .*/resolve/")}
    assert again
    assert not again & (arrived - {layout.INFO})  # which is read first, to see the format


@pytest.mark.parametrize("status", [500, 503])
def test_a_hub_that_has_an_error_now_and_then_is_asked_again(hub: HubServer, root: Path, status: int) -> None:
    hub.faults = [Fault("^PUT", times=2, status=status), Fault("/preupload/", status=status)]
    send(root)
    assert stored(hub) == content(root)


def test_a_connection_that_breaks_during_a_download_is_taken_up(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    hub.faults = [Fault("^GET .*/resolve/.*/data/", times=2, after_bytes=100)]
    pull(HubDataset("me/d"), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)


@pytest.mark.parametrize(
    ("token", "name", "words"),
    [
        (None, "me/d", "no token"),
        ("read_me", "me/d", "no permission"),
        ("hf_me", "other/d", "no permission"),
        ("nonsense", "me/d", "expired or was revoked"),
    ],
)
def test_who_may_not_write_is_told_why(running_hub: HubServer, root: Path, token, name: str, words: str) -> None:
    before = content(root)
    running_hub.repositories.clear()
    with real_client(running_hub, token), pytest.raises(TransferError, match=words):
        push(root, HubDataset(name, create=True))
    assert content(root) == before


def test_a_token_that_expires_in_the_middle(hub: HubServer, root: Path) -> None:
    hub.faults = [Fault("/commit/", status=401)]
    with pytest.raises(TransferError, match="expired or was revoked"):
        send(root)
    send(root)
    assert stored(hub) == content(root)


def test_what_is_not_there_is_named(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    with pytest.raises(TransferError, match="no such repository"):
        pull(HubDataset("me/none"), tmp_path / "e")
    with pytest.raises(TransferError, match="no revision 'old'"):
        pull(HubDataset("me/d", "old"), tmp_path / "e")
    hub.dataset("me/d").add("empty", {})
    with pytest.raises(TransferError, match="no LeRobot dataset"):
        pull(HubDataset("me/d", "empty"), tmp_path / "e")
    assert not (tmp_path / "e").exists()


def test_without_network(hub: HubServer, root: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(TransferError, match=r"cannot be reached.*HF_ENDPOINT"):
        send(root)
    with pytest.raises(TransferError, match="cannot be reached"):
        pull(HubDataset("me/d"), tmp_path / "e")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(TransferError, match="HF_HUB_OFFLINE"):
        send(root)


def test_a_private_repository_stays_so(hub: HubServer, root: Path, tmp_path: Path, monkeypatch) -> None:
    push(root, HubDataset("me/d", create=True, private=True))
    send(root)  # says nothing about it: fine
    with pytest.raises(TransferError, match="is private; public was asked for"):
        push(root, HubDataset("me/d", create=True, private=False))
    monkeypatch.setenv("HF_TOKEN", "hf_other")
    with pytest.raises(TransferError, match="no such repository"):
        pull(HubDataset("me/d"), tmp_path / "e")


def test_branches_and_tags(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    first = stored(hub)
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    push(root, HubDataset("me/d", "more", create=True, tag="seven"))
    assert stored(hub) == first  # neither main nor its tag moved
    assert stored(hub, "more") == stored(hub, "seven") == content(root)
    assert stored(hub, "v3.0") == first
    for revision, episodes in (
        (None, 6),
        ("main", 6),
        ("more", 7),
        ("seven", 7),
        (hub.dataset("me/d").tags["v3.0"], 6),
    ):
        assert pull(HubDataset("me/d", revision), tmp_path / f"to_{revision}").total_episodes == episodes
    with pytest.raises(TransferError, match="is a tag"):
        send(root, "seven")


def test_two_who_push_at_once_do_not_mix(hub: HubServer, root: Path, monkeypatch) -> None:
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
    with pytest.raises(TransferError, match="somebody else changed it"):
        push(root, remote)


def test_a_dataset_that_changes_during_the_upload_is_not_shown(hub: HubServer, root: Path) -> None:
    gate = threading.Event()
    hub.faults = [Fault("^PUT", wait=gate)]

    def change() -> None:
        path = root / layout.STATS
        path.write_bytes(path.read_bytes() + b" ")
        gate.set()

    timer = threading.Timer(0.3, change)
    timer.start()
    with pytest.raises(DatasetError, match=r"changed by another program.*meta/stats\.json"):
        send(root)
    timer.join()
    assert stored(hub) == {}
    send(root)
    assert stored(hub) == content(root)


def test_a_dataset_in_use_is_refused(hub: HubServer, root: Path, tmp_path: Path) -> None:
    lock = RootLock(root)
    with pytest.raises(DatasetLockedError, match="in use"):
        send(root)
    lock.release()
    send(root)
    shutil.rmtree(tmp_path / "d")
    pull(HubDataset("me/d"), root)
    lock = RootLock(root)
    with pytest.raises(DatasetLockedError):
        pull(HubDataset("me/d"), root)
    lock.release()


def test_a_recording_is_refused_until_it_is_finalised(hub: HubServer, tmp_path: Path) -> None:
    recorder = support.create(tmp_path / "d")
    support.record(recorder)
    with pytest.raises(DatasetLockedError, match="in use"):
        send(tmp_path / "d")
    recorder._lock.release()  # as after a kill
    with pytest.raises(DatasetError, match=r"not finalised.*bhd-data repair"):
        send(tmp_path / "d")
    recorder.finalize()
    send(tmp_path / "d")
    assert stored(hub) == content(tmp_path / "d")


def test_damaged_and_empty_datasets_are_refused(hub: HubServer, root: Path, tmp_path: Path) -> None:
    next((root / "data").rglob("*.parquet")).unlink()
    with pytest.raises(DatasetCorruptError, match="parquet"):
        send(root)
    support.create(tmp_path / "empty").finalize()
    with pytest.raises(DatasetError, match="no episode"):
        send(tmp_path / "empty")
    with pytest.raises(DatasetError, match="does not exist"):
        send(tmp_path / "none")
    assert not hub.repositories


def test_hidden_files_and_leftovers_stay_here(hub: HubServer, root: Path) -> None:
    (root / ".cache").mkdir()
    (root / ".cache" / "x").write_text("x")
    (root / "notes.md").write_text("mine")
    leftover = root / "data/chunk-000/file-077.parquet"
    leftover.write_bytes(b"x")
    report = send(root)
    assert report.left_out == ["data/chunk-000/file-077.parquet"]
    assert "notes.md" in stored(hub)
    assert not [path for path in stored(hub) if path.startswith(".") or "077" in path]


# --- cards


def card(text: str = "# made\n") -> Card:
    return Card(sign(text), b"picture")


def test_a_generated_card_is_renewed_and_a_persons_is_kept(hub: HubServer, root: Path) -> None:
    send(root, make_card=lambda state, has_picture: card())
    assert stored(hub)["preview.png"] == b"picture"
    assert not send(root, make_card=lambda state, has_picture: card("# made anew\n")).kept_card
    assert b"anew" in stored(hub)["README.md"]
    edited = stored(hub)["README.md"].replace(b"anew", b"by hand")
    assert not is_generated(edited.decode())
    hub.dataset("me/d").objects.clear()
    files = hub.dataset("me/d").files()
    files["README.md"].content = edited
    report = send(root, make_card=lambda state, has_picture: card("# third\n"))
    assert report.kept_card
    assert stored(hub)["README.md"] == edited
    assert not send(root, make_card=lambda state, has_picture: card("# third\n"), replace_card=True).kept_card
    assert b"third" in stored(hub)["README.md"]


def test_a_card_beside_the_dataset_is_the_card(hub: HubServer, root: Path) -> None:
    send(root, make_card=lambda state, has_picture: card())
    (root / "README.md").write_text("# my own\n")
    assert not send(root, make_card=lambda state, has_picture: card("# second\n")).kept_card
    assert stored(hub)["README.md"] == b"# my own\n"
    assert not send(root, make_card=lambda state, has_picture: card("# third\n")).kept_card  # it is the same
    (root / "README.md").write_text("# my own, newer\n")
    assert send(root).kept_card  # the one there is a person's, too
    assert stored(hub)["README.md"] == b"# my own\n"


# --- subsets and targets


def test_some_episodes_bring_only_their_files_and_load(hub: HubServer, root: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    send(root)
    target = tmp_path / "e"
    hub.reset()
    report = pull(HubDataset("me/d"), target, select=lambda folder: [0, 1])
    assert report.episodes == [0, 1]
    data = {path for path in content(target) if path.startswith(("data/", "videos/"))}
    assert data == files_of(root, [0, 1]) < {path for path in content(root) if path.startswith(("data/", "videos/"))}
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


def test_episodes_that_do_not_exist(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    with pytest.raises(DatasetError, match=r"no episode 6.*from 0 to 5"):
        pull(HubDataset("me/d"), tmp_path / "e", select=lambda folder: [6])
    assert list(tmp_path.iterdir()) == [root]


def test_a_changed_dataset_is_not_overwritten_unless_that_is_said(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    target = tmp_path / "e"
    pull(HubDataset("me/d"), target)
    (target / "notes.txt").write_text("mine")
    (target / layout.STATS).write_text("{}")
    before = content(target)
    with pytest.raises(DatasetExistsError, match=r"meta/stats\.json.*--replace"):
        pull(HubDataset("me/d"), target)
    assert content(target) == before
    hub.reset()
    report = pull(HubDataset("me/d"), target, replace=True)
    assert report.fetched == [layout.STATS]
    assert content(target) == content(root) | {"notes.txt": b"mine"}


def test_folders_that_are_no_place_for_a_dataset(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    (tmp_path / "empty").mkdir()
    for name in ("file", "full"):
        with pytest.raises(DatasetExistsError, match="Choose another folder"):
            pull(HubDataset("me/d"), tmp_path / name)
    pull(HubDataset("me/d"), tmp_path / "empty")
    assert content(tmp_path / "empty") == content(root)
    with pytest.raises(DatasetWriteError, match=r"not a folder|Not a directory"):
        pull(HubDataset("me/d"), tmp_path / "file" / "below")


def test_a_kill_between_the_renames_is_mended(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    target = tmp_path / "e"
    pull(HubDataset("me/d"), target)
    (target / ".bhd-pull").touch()
    target.rename(tmp_path / ".e.old")
    assert pull(HubDataset("me/d"), target).fetched == []
    assert content(target) == content(root)


@pytest.mark.parametrize("name", [".e.old", ".e.pull"])
def test_folders_of_others_in_its_way_are_left_alone(hub: HubServer, root: Path, tmp_path: Path, name: str) -> None:
    send(root)
    (tmp_path / name).mkdir()
    (tmp_path / name / "thesis.txt").write_text("years")
    with pytest.raises(DatasetError, match="is in the way"):
        pull(HubDataset("me/d"), tmp_path / "e")
    assert (tmp_path / name / "thesis.txt").read_text() == "years"
    assert not (tmp_path / "e").exists()


def test_a_folder_behind_a_link_is_not_taken_for_gone(hub: HubServer, root: Path, tmp_path: Path) -> None:
    """What is not seen must not be removed at the other end."""
    copied = Path(shutil.copytree(root, tmp_path / "copied"))
    send(root)
    before = HubDataset("me/d").files()
    (copied / "videos").rename(tmp_path / "big")
    (copied / "videos").symlink_to(tmp_path / "big")
    with pytest.raises(DatasetError, match="behind a link"):
        send(copied)
    assert HubDataset("me/d").files() == before


def test_a_full_disk_is_seen_before_and_during(hub: HubServer, root: Path, tmp_path: Path, monkeypatch) -> None:
    send(root)
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(remote_pull.shutil, "disk_usage", lambda path: usage._replace(free=100))
        with pytest.raises(TransferError, match=r"MB are missing.*0.0 MB free"):
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


def test_damage_on_the_way_is_noticed(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    blob = next(blob for path, blob in hub.dataset("me/d").files().items() if path.startswith("data/"))
    honest = type(blob).sha256
    broken = bytearray(blob.content)
    broken[10] ^= 1
    listed = blob.sha256
    blob.content = bytes(broken)
    try:
        type(blob).sha256 = property(lambda one: listed if one is blob else honest.fget(one))  # type: ignore
        with pytest.raises(TransferError, match="came otherwise than it was listed"):
            pull(HubDataset("me/d"), tmp_path / "e")
    finally:
        type(blob).sha256 = honest
    assert not (tmp_path / "e").exists()


def test_names() -> None:
    for wrong in ("d", "me/d/e", "me/", "/d", "me/d.git", "me/a--b", "me/a..b", "../d", "me/a b", ""):
        with pytest.raises(ConfigError, match="user/name"):
            HubDataset(wrong)


# --- loading by name


def test_loading_by_name_downloads_only_the_wanted_episodes(
    hub: HubServer, root: Path, tmp_path: Path, monkeypatch
) -> None:
    send(root)
    hub.reset()
    meta = local_metadata("me/d", tmp_path / "one", episodes=[0])
    assert meta.total_episodes == EPISODES
    data = {path for path in content(tmp_path / "one") if path.startswith(("data/", "videos/"))}
    assert data == files_of(root, [0])
    local_metadata("me/d", tmp_path / "two", select=lambda found: [EPISODES - 1])
    data = {path for path in content(tmp_path / "two") if path.startswith(("data/", "videos/"))}
    assert data == files_of(root, [EPISODES - 1])


def test_loading_by_name_says_what_is_wrong(hub: HubServer, root: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such repository"):
        local_metadata("me/d", tmp_path / "e")
    send(root)
    with pytest.raises(DatasetError, match="no revision 'old'"):
        local_metadata("me/d", tmp_path / "e", revision="old")
    with pytest.raises(ConfigError, match="does not say which"):
        local_metadata("me/d", root, revision="main")


def test_a_tag_of_a_release_does_not_move(hub: HubServer, root: Path) -> None:
    push(root, HubDataset("me/d", create=True, tag="one"))
    push(root, HubDataset("me/d", create=True, tag="one"))  # the same again
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    with pytest.raises(TransferError, match="has a tag 'one' already"):
        push(root, HubDataset("me/d", create=True, tag="one"))
    assert stored(hub) == stored(hub, "one") != content(root)


def test_what_is_not_sound_there_comes_as_it_is_and_that_is_said(hub: HubServer, root: Path, tmp_path: Path) -> None:
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
    assert not hub.asked("GET .*/resolve/.*/data/")  # said before everything was fetched


def test_what_belongs_to_no_dataset_survives_an_exchange(hub: HubServer, root: Path, tmp_path: Path) -> None:
    """A dataset under version control, with links and folders of its own."""
    send(root)
    target = tmp_path / "e"
    pull(HubDataset("me/d"), target)
    (target / ".git/refs/tags").mkdir(parents=True)
    (target / ".git/HEAD").write_text("ref")
    (target / ".cache/app").mkdir(parents=True)
    (target / ".cache/app/x").write_text("x")
    (target / "plots").symlink_to(tmp_path)
    (target / "gone").symlink_to("nowhere")
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    send(root)
    assert pull(HubDataset("me/d"), target, replace=True).fetched
    assert (target / ".git/refs/tags").is_dir()
    assert (target / ".git/HEAD").read_text() == "ref"
    assert (target / ".cache/app/x").read_text() == "x"
    assert (target / "plots").is_symlink()
    assert (target / "gone").is_symlink()
    assert not (target / ".bhd-pull").exists()


def test_a_folder_that_is_no_dataset_is_never_replaced(hub: HubServer, root: Path, tmp_path: Path) -> None:
    send(root)
    (tmp_path / "e/data/chunk-000").mkdir(parents=True)
    (tmp_path / "e/data/chunk-000/file-777.parquet").write_text("mine")
    with pytest.raises(DatasetExistsError, match="is no dataset"):
        pull(HubDataset("me/d"), tmp_path / "e", replace=True)
    assert (tmp_path / "e/data/chunk-000/file-777.parquet").read_text() == "mine"


def test_what_the_repository_ignores_is_told(hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import HfApi

    preupload = HfApi.preupload_lfs_files

    def ignoring(self: HfApi, repo_id: str, additions: list, **options: object) -> None:
        preupload(self, repo_id, additions, **options)
        additions[0]._should_ignore = True

    monkeypatch.setattr(HfApi, "preupload_lfs_files", ignoring)
    with pytest.raises(TransferError, match=r"\.gitignore names"):
        send(root)
    assert layout.INFO not in HubDataset("me/d").files()
