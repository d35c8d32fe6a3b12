"""Bags, and datasets made of them, are there completely or not at all, whenever the process is killed."""

import contextlib
import filecmp
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.validate.findings import Severity
from bhd_lerobot.errors import DatasetExistsError
from bhd_lerobot.rosbag.exporter.export import ExportOptions, export_bags
from bhd_lerobot.rosbag.messages.views import RobotView
from bhd_lerobot.rosbag.storage.place import complete_or_not
from tests.datasets import support
from tests.datasets.kill_support import KillServer

EPISODES = 2


@pytest.fixture(scope="module")
def server() -> Iterator[KillServer]:
    server = KillServer("tests.rosbag.kill_server")
    yield server
    server.close()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("place") / "d"
    with support.create(root) as recorder:
        for _ in range(EPISODES):
            support.record(recorder)
    return root


@pytest.fixture(scope="module")
def bags(dataset: Path) -> Path:
    output = dataset.with_name("bags")
    export_bags(dataset, output, view=RobotView(), options=ExportOptions())
    return output


def files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_an_import_that_is_killed_at_any_step_leaves_no_dataset(
    server: KillServer, dataset: Path, bags: Path, tmp_path: Path
) -> None:
    """The same place is used again and again, as by somebody who repeats the command."""
    root, died_at, left = tmp_path / "d", 0, 0
    while server.edit("import", [root, bags], died_at):
        there = os.listdir(tmp_path)
        if root.exists():  # killed after the last step
            break
        assert len(there) <= 1, "an attempt removes what the one before left"
        assert all(name.startswith(".d.bhd-") for name in there)
        left += len(there)
        died_at += 1
    assert left > 20
    assert os.listdir(tmp_path) == ["d"]
    assert check_dataset(root).worst < Severity.WARNING
    for episode in range(EPISODES):
        new, old = read_episode(root, episode), read_episode(dataset, episode)
        for key in ("observation.state", "next.done"):
            assert (new[key] == old[key]).all(), key


@pytest.mark.parametrize("one_bag", [False, True])
def test_an_export_that_is_killed_at_any_step_leaves_no_bag(
    server: KillServer, dataset: Path, bags: Path, tmp_path: Path, one_bag: bool
) -> None:
    output, died_at, left = tmp_path / "bags", 0, 0
    while server.edit("export", [output, dataset], died_at, one_bag=one_bag):
        there = os.listdir(tmp_path)
        assert len(there) <= 1
        assert all(name.startswith(".bags.bhd-") for name in there)
        left += len(there)
        died_at += 1
    assert left >= 5
    assert os.listdir(tmp_path) == ["bags"]
    if not one_bag:
        assert files(output) == files(bags)
        assert all(filecmp.cmp(output / name, bags / name, shallow=False) for name in files(bags))


def test_a_living_attempt_keeps_its_folder_and_the_first_to_end_has_the_place(tmp_path: Path) -> None:
    target = tmp_path / "bags"
    told = ("--output", "write bags", "Nothing was written.")
    with contextlib.ExitStack() as attempts:
        slow = attempts.enter_context(complete_or_not(target, *told))
        slow.mkdir()
        with complete_or_not(target, *told) as quick:
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
        pytest.raises(DatasetExistsError, match="a link to nothing"),
        complete_or_not(tmp_path / "link", "--root", "import bags", ""),
    ):
        pass
    assert os.listdir(tmp_path) == ["link"]


@pytest.mark.parametrize("moves", [0, 1, 6, 9])
def test_a_full_disk_leaves_no_dataset_and_promises_none(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], moves: int
) -> None:
    """What the recorder says of saved episodes, and of `repair`, is not true of an import."""

    count, move = itertools.count(), Disk.move

    def refuse(disk: Disk, source: Path, target: Path) -> None:
        if next(count) >= moves:
            raise OSError(28, "No space left on device")
        move(disk, source, target)

    monkeypatch.setattr(Disk, "move", refuse)
    assert main.main(["import", str(bags), "--repo_id=t/t", f"--root={tmp_path / 'd'}"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "No space left" in error
    assert "No dataset was made." in error
    assert "intact" not in error
    assert os.listdir(tmp_path) == []
