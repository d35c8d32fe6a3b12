"""What holds for every place: the Hub, memory, a folder, an S3-compatible store; all of them on this machine."""

from pathlib import Path

import pytest

from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError, DatasetExistsError
from tests.datasets import support
from tests.datasets.remote.store_fixtures import Place
from tests.datasets.support import snapshot as content
from tests.fake_hub.fixtures import EPISODES


@pytest.mark.law
def test_what_comes_back_is_what_was_recorded(root: Path, place: Place, tmp_path: Path) -> None:
    report = push(root, place.remote())
    assert place.stored() == content(root)
    assert (report.episodes, len(report.sent), report.kept) == (EPISODES, len(content(root)), 0)
    fetched = pull(place.remote(), tmp_path / "e")
    assert content(tmp_path / "e") == content(root)
    assert (fetched.episodes, fetched.kept) == (None, 0)
    assert support.verify(tmp_path / "e", EPISODES, video=True, stats=True) == EPISODES
    assert {one.name for one in tmp_path.iterdir()} <= {"d", "e", "there"}  # nothing is left beside it
    # The same again changes nothing; from and to the Hub nothing moves.
    moved = [] if place.hub is not None else sorted(content(root))
    if place.hub is not None:
        place.hub.reset()
    assert sorted(push(root, place.remote()).sent) == moved
    assert pull(place.remote(), tmp_path / "e").fetched == moved
    assert content(tmp_path / "e") == content(root)
    if place.hub is not None:
        assert not place.hub.asked("^PUT|/commit/|/tag/|/resolve/")
        repository = place.hub.dataset("me/d")
        assert len(repository.commits) == 2  # the Hub's own first one, and the dataset
        assert repository.tags == {"v3.0": repository.branches["main"]}  # which LeRobot looks for


def test_a_longer_dataset_replaces_what_differs_and_removes_what_is_old(root: Path, place: Place) -> None:
    push(root, place.remote())
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    report = push(root, place.remote())
    assert place.stored() == content(root)
    assert layout.INFO in report.sent
    if place.hub is not None:
        assert report.kept > 0
        repository = place.hub.dataset("me/d")
        assert repository.tags["v3.0"] == repository.branches["main"]


def test_a_dataset_that_changes_during_the_upload_is_not_shown(root, place, monkeypatch):
    remote = place.remote()
    files = remote.files

    def files_and_change() -> object:
        (root / layout.STATS).write_text("{}")
        return files()

    monkeypatch.setattr(remote, "files", files_and_change)
    with pytest.raises(DatasetError, match=r"changed by another program.*meta/stats\.json"):
        push(root, remote)
    assert layout.INFO not in place.stored()


def test_a_dataset_that_was_changed_here_is_kept_unless_it_is_given_up(root, place, tmp_path):
    push(root, place.remote())
    target = tmp_path / "e"
    pull(place.remote(), target)
    (target / "notes.txt").write_text("mine")
    (target / layout.STATS).write_text("{}")
    before = content(target)
    with pytest.raises(DatasetExistsError, match=r"meta/stats\.json.*--replace"):
        pull(place.remote(), target)
    assert content(target) == before
    assert layout.STATS in pull(place.remote(), target, replace=True).fetched
    assert content(target) == content(root) | {"notes.txt": b"mine"}
