"""What is pushed and what is not: the dataset that is checked before, and its card. To a Hub on this machine."""

import shutil
from pathlib import Path

import pytest

from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.push import Card, MakeCard, is_generated, sign
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, DatasetLockedError
from tests.datasets import support
from tests.datasets.support import snapshot as content
from tests.fake_hub.fixtures import send, stored
from tests.fake_hub.hub import FakeHub


def test_a_recording_is_refused_until_it_is_finalised(hub: FakeHub, tmp_path: Path) -> None:
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


def test_damaged_and_empty_datasets_are_refused(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    next((root / "data").rglob("*.parquet")).unlink()
    with pytest.raises(DatasetCorruptError, match="parquet"):
        send(root)
    support.create(tmp_path / "empty").finalize()
    with pytest.raises(DatasetError, match="no episode"):
        send(tmp_path / "empty")
    with pytest.raises(DatasetError, match="does not exist"):
        send(tmp_path / "none")
    assert not hub.repositories


def test_hidden_files_and_leftovers_stay_here(hub: FakeHub, root: Path) -> None:
    (root / ".cache").mkdir()
    (root / ".cache" / "x").write_text("x")
    (root / "notes.md").write_text("mine")
    leftover = root / "data/chunk-000/file-077.parquet"
    leftover.write_bytes(b"x")
    report = send(root)
    assert report.left_out == ["data/chunk-000/file-077.parquet"]
    assert "notes.md" in stored(hub)
    assert not [path for path in stored(hub) if path.startswith(".") or "077" in path]


def card(text: str = "# made\n") -> Card:
    return Card(sign(text), b"image")


def made(text: str = "# made\n") -> MakeCard:
    return lambda state, has_image: card(f"{text}{has_image}")


def test_a_generated_card_is_renewed_and_another_one_is_kept(hub: FakeHub, root: Path) -> None:
    send(root, make_card=made())
    assert stored(hub)["preview.png"] == b"image"
    assert not send(root, make_card=made("# made anew\n")).kept_card
    edited = stored(hub)["README.md"].replace(b"anew", b"by hand")
    assert not is_generated(edited)
    hub.dataset("me/d").files()["README.md"].content = edited
    for make in (made("# third\n"), None):
        assert send(root, make_card=make).kept_card
        assert stored(hub)["README.md"] == edited


def test_a_card_beside_the_dataset_is_the_card(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    for text, theirs in (("# my own\n", card().text), ("# newer\n", "# my own\n"), ("# newer\n", "# of somebody\n")):
        if hub.repositories:
            hub.dataset("me/d").files()["README.md"].content = theirs.encode()
        (root / "README.md").write_text(text)
        assert not send(root, make_card=made()).kept_card
        assert stored(hub)["README.md"] == text.encode()
        assert "preview.png" not in stored(hub)
    # One that was generated and came with a pull is generated anew.
    (root / "README.md").write_text(card().text)
    hub.dataset("me/d").files()["README.md"].content = card().text.encode()
    assert "README.md" in send(root, make_card=made("# anew\n")).sent
    assert b"anew" in stored(hub)["README.md"]


def test_a_folder_behind_a_link_is_not_removed_from_the_hub(hub, root, tmp_path, monkeypatch):
    """What is not seen must not be removed at the other end."""
    copied = Path(shutil.copytree(root, tmp_path / "copied"))
    send(root)
    before = HubDataset("me/d").files()
    (copied / "videos").rename(tmp_path / "big")
    (copied / "videos").symlink_to(tmp_path / "big")
    for declared, message in (("", "is a link to .*big"), (tmp_path / "big", "behind a link")):
        monkeypatch.setenv("BHD_LINKED_FOLDERS", str(declared))
        with pytest.raises(DatasetError, match=message):
            send(copied)
    assert HubDataset("me/d").files() == before


def test_a_note_that_is_a_link_to_the_outside_is_not_sent(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").write_text("password")
    (root / ".step").symlink_to(tmp_path / "outside")
    (root / "notes.txt").symlink_to(root / ".step")  # by way of a link that stays inside
    with pytest.raises(DatasetError, match=r"notes.txt is a link to .*outside, outside of the dataset.*cp -rL"):
        send(root)
    assert not hub.repositories  # no request was sent to the Hub
    send(Path(shutil.copytree(root, tmp_path / "whole")))  # which follows links, as cp -rL does
