"""Pushes that meet: two at once below a URL, and one after another that did not end. Nothing is mixed or lost."""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import fsspec
import pytest

from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.remote import hub as hub_module
from bhd_lerobot.datasets.remote.listing import Item
from bhd_lerobot.datasets.remote.pull import pull
from bhd_lerobot.datasets.remote.push import push
from bhd_lerobot.datasets.remote.store import StoreDataset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetExistsError, TransferError
from tests.datasets import support
from tests.datasets.remote.store_fixtures import stored
from tests.hub_server.fixtures import content, send
from tests.hub_server.fixtures import stored as on_hub
from tests.hub_server.server import Fault, HubServer

pytest_plugins = ["tests.datasets.remote.store_fixtures", "tests.hub_server.fixtures"]

URL = "memory://b/d"


@pytest.fixture
def few(few_files: Path, tmp_path: Path) -> Path:
    fsspec.filesystem("memory").store.clear()
    return Path(shutil.copytree(few_files, tmp_path / "few"))


def changed(root: Path, path: str, end: bytes) -> Path:
    """Return a copy in which a file is another one of the same size; different ends make different files."""
    copy = Path(shutil.copytree(root, root.with_name(f"copy{end.hex()}")))
    (copy / path).write_bytes((root / path).read_bytes() + end)
    return copy


class Meeting(StoreDataset):
    """Lets something happen before or after a write, once."""

    def __init__(self, happen: Callable[[], None], before: int = -1, after: str = "") -> None:
        super().__init__(URL)
        self.happen, self.before, self.after, self.writes = happen, before, after, 0

    def _put_one(self, item: Item) -> None:
        if self.writes == self.before:
            self.happen()
        self.writes += 1
        super()._put_one(item)
        if item.path == self.after:
            self.happen()


def quietly(root: Path, store: StoreDataset) -> str:
    """Push; return why it failed, or nothing."""
    try:
        push(root, store)
    except TransferError as error:
        return str(error)
    return ""


def test_a_push_in_the_middle_of_another_one_mixes_nothing(few: Path, tmp_path: Path) -> None:
    """At every write of the one: what is shown then is one of the two, and either can be pushed again.

    Not at the first write, which comes a request after the last look: no store can do both at once.
    """
    one, other = changed(few, layout.STATS, b" "), changed(few, layout.STATS, b"\n")
    (other / layout.IDENTITY).write_bytes(
        (few / layout.IDENTITY).read_bytes() + b"\n"
    )  # which the one finds there as it is
    step = 1
    while True:
        fsspec.filesystem("memory").store.clear()
        push(few, StoreDataset(URL))
        store = Meeting(lambda: push(other, StoreDataset(URL)), before=step)
        said = quietly(one, store)
        if store.writes <= step:
            break
        assert "at the same time" in said or stored(URL) in (content(one), content(other)), step
        assert said == "" or layout.INFO not in stored(URL)
        for root in (other, one):
            push(root, StoreDataset(URL))
            assert stored(URL) == content(root), step
        step += 1
    assert step >= 5


def test_a_push_that_comes_while_another_one_looks_is_not_overwritten_in_part(few: Path) -> None:
    one, other = changed(few, layout.STATS, b" "), changed(few, layout.IDENTITY, b"\n")
    push(few, StoreDataset(URL))
    store = StoreDataset(URL)
    files = store.files
    store.files = lambda: [files(), push(other, StoreDataset(URL))][0]  # type: ignore[method-assign]
    with pytest.raises(TransferError, match="since this one looked at it"):
        push(one, store)
    assert stored(URL) == content(other)


def test_who_ends_last_notices_who_wrote_over_his_files(few: Path) -> None:
    """Sizes are the same, so only the list could tell what lies there; and it is the other one's."""
    one, other = changed(few, layout.STATS, b" "), changed(few, layout.STATS, b"\n")
    push(few, StoreDataset(URL))
    has_written, may_go_on = threading.Event(), threading.Event()
    said: list[str] = []
    late = Meeting(lambda: (has_written.set(), may_go_on.wait(60)), after=layout.STATS)  # type: ignore
    thread = threading.Thread(target=lambda: said.append(quietly(other, late)))
    thread.start()
    assert has_written.wait(60)
    said.append(quietly(one, Meeting(lambda: (may_go_on.set(), thread.join()), after=layout.STATS)))  # type: ignore
    assert any("at the same time" in one for one in said)
    assert layout.INFO not in stored(URL)
    for root in (other, one):
        push(root, StoreDataset(URL))
        assert stored(URL) == content(root)


def test_an_older_copy_does_not_replace_what_a_push_that_ended_early_was_at(few: Path, tmp_path: Path) -> None:
    old = Path(shutil.copytree(few, tmp_path / "old"))
    with support.resume(few, video=True) as recorder:
        support.record(recorder, video=True)
    push(few, StoreDataset(URL))
    with support.resume(few, video=True) as recorder:
        support.record(recorder, video=True)

    def die() -> None:
        raise ConnectionResetError("gone")

    with pytest.raises(TransferError):
        push(few, Meeting(die, before=2))
    with pytest.raises(DatasetExistsError, match=r"before a push to it that did not end, had 4 episodes.*has 3"):
        push(old, StoreDataset(URL))
    push(few, StoreDataset(URL))
    assert stored(URL) == content(few)


def test_an_older_copy_does_not_replace_what_a_push_of_several_commits_was_at(
    hub: HubServer, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = Path(shutil.copytree(root, tmp_path / "old"))
    with support.resume(root, video=True) as recorder:
        support.record(recorder, video=True)
    send(root)
    for name in ("a.md", "b.md"):
        (root / name).write_text("mine")
    monkeypatch.setattr(hub_module, "_COMMIT_SIZE", 1)
    hub.faults = [Fault("/commit/", times=-1, after=1)]
    with pytest.raises(TransferError):
        send(root)
    hub.faults = []
    with pytest.raises(DatasetExistsError, match="had 7 episodes"):
        send(old)
    send(root)
    assert on_hub(hub) == content(root)


def test_episodes_that_were_deleted_before_the_copy_excuse_nothing(few: Path, tmp_path: Path) -> None:
    longer = tmp_path / "longer"
    with support.create(longer, video=True) as recorder:
        for _ in range(4):
            support.record(recorder, video=True)
    delete(few, [0])
    push(few, StoreDataset(URL))
    delete(few, [0])
    push(few, StoreDataset(URL))  # one fewer, and one was deleted since
    push(longer, StoreDataset(URL))
    with pytest.raises(DatasetExistsError, match=r"has 4 episodes, .* has 1 and 2 were deleted from it since"):
        push(few, StoreDataset(URL))
    pull(StoreDataset(URL), tmp_path / "e")
    assert content(tmp_path / "e") == content(longer)
