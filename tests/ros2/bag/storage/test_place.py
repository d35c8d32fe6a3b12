"""Bags, and datasets made of them, come to their place complete or not at all.

The sweeps kill, interrupt and fill the disk of exports and imports: `tests/datasets/sweeps`.
"""

import contextlib
import itertools
import os
from pathlib import Path

import pytest

from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import DatasetExistsError
from bhd_lerobot.ros2.bag.storage.place import complete_or_not
from tests.cli.data.import_support import run
from tests.ros2.bag.support import drive, write


@pytest.mark.law
def test_a_living_attempt_keeps_its_folder_and_the_first_to_end_has_the_place(tmp_path: Path) -> None:
    target = tmp_path / "bags"
    named = ("--output", "write bags", "Nothing was written.")
    with contextlib.ExitStack() as attempts:
        slow = attempts.enter_context(complete_or_not(target, *named))
        slow.mkdir()
        with complete_or_not(target, *named) as quick:
            assert slow.is_dir()
            assert quick.parent != slow.parent
            quick.mkdir()
            (quick / "bag").write_text("quick")
        assert os.listdir(target) == ["bag"]
        (slow / "bag").write_text("slow")
        with pytest.raises(DatasetExistsError, match="choose another --output"):
            attempts.close()
    assert os.listdir(tmp_path) == ["bags"]
    assert (target / "bag").read_text() == "quick"


def test_what_ended_after_the_last_step_is_removed_though_the_place_is_taken(tmp_path: Path) -> None:
    (tmp_path / ".d.bhd-killed00" / "d").mkdir(parents=True)
    (tmp_path / ".d.other").mkdir()
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "note").write_text("mine")
    with pytest.raises(DatasetExistsError), complete_or_not(tmp_path / "d", "--root", "import bags", ""):
        pass
    assert sorted(os.listdir(tmp_path)) == [".d.other", "d"]


@pytest.mark.parametrize("place", ["empty", "link", "new/../d", "deep/er"])
def test_it_comes_to_the_place_that_was_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("empty")
    target = tmp_path / place
    with complete_or_not(target, "--output", "write bags", "") as folder:
        folder.mkdir()
        (folder / "bag").touch()
    assert os.listdir(target.resolve()) == ["bag"]
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_a_link_to_nothing_stays(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    with (
        pytest.raises(DatasetExistsError, match="a broken link"),
        complete_or_not(tmp_path / "link", "--root", "import bags", ""),
    ):
        pass
    assert os.listdir(tmp_path) == ["link"]


def test_a_full_disk_leaves_no_dataset(tmp_path, monkeypatch, capsys):
    """The recorder's message about saved episodes, and `repair`, does not hold for an import."""
    write(tmp_path / "bag", drive(seconds=2))
    move = Disk.move
    for moves in (0, 1, 6):
        count = itertools.count()

        def refuse(disk: Disk, source: Path, target: Path, *, count=count, moves=moves) -> None:
            if next(count) >= moves:
                raise OSError(28, "No space left on device")
            move(disk, source, target)

        monkeypatch.setattr(Disk, "move", refuse)
        assert run(tmp_path / "bag", tmp_path / "new", "--beams=36") == 2
        error = " ".join(capsys.readouterr().err.split())
        assert "No space left" in error
        assert "No dataset was made." in error
        assert "intact" not in error
        assert os.listdir(tmp_path) == ["bag"]
