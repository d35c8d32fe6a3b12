"""New content takes its place in one step, wherever that is; the sweeps say what happens when it is disturbed."""

import errno
import json
import logging
import os
import shutil
import signal
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.edit.edits import delete, keep, merge, split
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.loader.table import open_metadata
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.storage import atomic, disk, layout
from bhd_lerobot.datasets.storage.disk import Disk, RootLock
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import DatasetError, DatasetExistsError, DatasetLockedError
from tests.datasets import support
from tests.datasets.edit_support import content, record
from tests.datasets.sweeps.operations import leftovers
from tests.forks import Fork


@pytest.fixture
def root(three_episodes: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(three_episodes, tmp_path / "d"))


def names(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


def test_files_of_others_in_a_dataset_stay_unchanged(root: Path) -> None:
    (root / "README.md").write_text("mine")
    (root / "own/deep/empty").mkdir(parents=True)
    (root / "own/secret").write_text("mine")
    (root / "own/secret").chmod(0o600)
    (root / "link").symlink_to("own/secret")
    root.chmod(0o750)
    inode = (root / "own/secret").stat().st_ino
    delete(root, [1])
    assert [one.task for one in content(root)] == [["task 0"], ["task 0"]]
    assert (root / "README.md").read_text() == "mine"
    assert (root / "own/deep/empty").is_dir()
    assert ((root / "own/secret").stat().st_mode & 0o777, (root / "own/secret").stat().st_ino) == (0o600, inode)
    assert os.readlink(root / "link") == "own/secret"
    assert root.stat().st_mode & 0o777 == 0o750
    assert leftovers(root.parent) == []


def test_files_that_others_write_during_an_edit_stay(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anywhere below the dataset but in its own three folders; also by a rename, as editors save."""
    (root / "own").mkdir()
    (root / "own/notes").write_text("old")
    inode = root.stat().st_ino
    count = 0

    def write(action: str, path: Path) -> None:
        nonlocal count
        count += 1
        (root / f"own/{count}").touch()
        (root / "own/next").write_text(str(count))
        (root / "own/next").rename(root / "own/notes")
        (root / "late.txt").write_text(str(count))

    monkeypatch.setattr(disk, "_before_step", write)
    delete(root, [1])
    assert len(list((root / "own").iterdir())) == count + 1
    assert (root / "own/notes").read_text() == (root / "late.txt").read_text() == str(count)
    assert root.stat().st_ino == inode, "who stands in it, or has mounted it, sees the new content"


def recording_on(root: Path) -> Callable[[], object]:
    """Save a further episode; return what finalises the dataset."""
    recorder = support.resume(root)
    support.record(recorder)
    return recorder.finalize


def without_statistics(root: Path) -> Callable[[], object]:
    """Remove the statistics; return what computes them."""
    (root / layout.STATS).unlink()
    return lambda: fix(root, check_dataset(root).findings)


@pytest.mark.law
@pytest.mark.parametrize("prepare", [lambda root: lambda: delete(root, [1]), recording_on, without_statistics])
def test_the_old_content_goes_when_the_new_is_on_the_device(
    root: Path, monkeypatch: pytest.MonkeyPatch, prepare: Callable[[Path], Callable[[], object]]
) -> None:
    """A power failure right after an edit, or after a recording, costs nothing that was saved long before."""
    change, fsync = prepare(root), os.fsync
    safe = {path.lstat().st_ino for path in root.rglob("*")}
    found: list[Path] = []

    def flush(handle: int) -> None:
        fsync(handle)
        safe.add(os.fstat(handle).st_ino)

    def look(action: str, path: Path) -> None:
        if action == "rmtree" and path == root / atomic.WORK and not found:
            found.extend(one for one in (root, *root.rglob("*")) if not one.is_relative_to(root / layout.STAGING))
            assert [str(one) for one in found if one.lstat().st_ino not in safe] == []

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(disk, "_before_step", look)
    change()
    assert root / layout.STATS in found


def test_a_file_system_that_cannot_flush_folders_will_do(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fsync = os.fsync

    def flush(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", flush)
    delete(root, [1])
    assert len(content(root)) == 2


@pytest.mark.law
def test_a_mixture_of_old_and_new_never_loads(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between any two changes of the disk a stock LeRobot finds the old dataset or the new one, or is refused."""
    old = content(root)
    new = [old[0], old[2]]
    seen: list[int] = []

    def observe(action: str, path: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(disk, "_before_step", lambda *_: None)
            if json.loads((root / "meta/info.json").read_text())["codebase_version"].startswith("v3."):
                found = content(root)
                assert found in (old, new)
                seen.append(len(found))
            else:
                with pytest.raises(Exception, match="bhd-data repair"):
                    LeRobotDatasetMetadata("t/t", root=root)
                seen.append(0)

    monkeypatch.setattr(disk, "_before_step", observe)
    delete(root, [1])
    assert list(dict.fromkeys(seen)) == [3, 0, 2]


def test_a_link_to_an_empty_folder_and_one_to_a_dataset_stay_links(root: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to("disk")
    keep(root, [0, 2], tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert len(content(tmp_path / "disk")) == 2
    delete(tmp_path / "link", [0])
    assert (tmp_path / "link").is_symlink()
    assert content(tmp_path / "disk") == [content(root)[2]]
    (tmp_path / "new").mkdir()
    (tmp_path / "to_new").symlink_to("new")
    with support.create(tmp_path / "to_new") as recorder:
        support.record(recorder)
    assert support.read_back(tmp_path / "new") == 1
    (tmp_path / "dangling").symlink_to("nowhere")
    with pytest.raises(DatasetExistsError, match="broken link"):
        keep(root, [0], tmp_path / "dangling")


def use_a_mount_point(root: Path, place: Path) -> None:
    """In a process of its own, whose mounts end with it."""
    user, group = os.getuid(), os.getgid()
    try:
        os.unshare(os.CLONE_NEWNS)
    except PermissionError:  # root's rights, in a namespace of its own
        os.unshare(os.CLONE_NEWUSER | os.CLONE_NEWNS)
        for name, line in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
            Path("/proc/self", name).write_text(line)
    assert os.system("mount --make-rprivate /") == 0

    def empty() -> Path:
        os.system(f"umount --lazy {place} 2>/dev/null")
        assert os.system(f"mount -t tmpfs tmpfs {place}") == 0
        (place / "lost+found").mkdir()
        return place

    with support.create(empty()) as recorder:
        support.record(recorder), support.record(recorder)
    with support.resume(place) as recorder:
        support.record(recorder)
    assert support.read_back(place) == 3
    delete(place, [1])
    assert sorted(os.listdir(place)) == ["data", "lost+found", "meta"], os.listdir(place)
    keep(root, [0, 2], empty())
    assert main.main(["mark", str(place), "--episodes=0", "--outcome=failure"]) == 0
    split(root, {"a": [0], "b": [1]}, empty())
    assert sorted(os.listdir(place)) == ["a", "b", "lost+found"]
    assert main.main(["export", str(root), "--output", str(empty())]) == 0
    again = shutil.copytree(root, root.parent / "again")
    assert main.main(["pull", f"file://{root}", "--root", str(empty())]) == 0
    delete(place, [0])
    assert main.main(["pull", f"file://{root}", "--root", str(place), "--replace"]) == 0
    assert support.read_back(place) == 3
    assert sorted(os.listdir(place)) == ["data", "lost+found", "meta"], os.listdir(place)
    assert os.system(f"umount --lazy {place} && mount --bind {again} {place}") == 0
    delete(place, [1])
    assert support.read_back(root) == 3
    assert len(os.listdir(place / "meta")) > 3
    other = root.parent / "bound"
    other.mkdir()
    assert os.system(f"mount --bind {root} {other}") == 0
    delete(root, [2])  # from outside of the container
    assert support.read_back(other) == 2
    assert os.system(f"umount --lazy {other} && mkdir {root}/kept && mount -t tmpfs tmpfs {root}/kept") == 0
    assert os.system(f"mount --bind {root}/data {root}/data") == 0
    before = sorted(os.listdir(root / "data/chunk-000"))
    assert main.main(["delete", str(root), "--episodes=0"]) == 2
    assert sorted(os.listdir(root / "data/chunk-000")) == before
    assert not (root / ".bhd").exists()
    assert support.read_back(root) == 2


def test_all_commands_work_at_a_mount_point(root: Path, tmp_path: Path) -> None:
    """Of a container, for example, whose volume is the dataset."""
    for options in (["--mount"], ["--mount", "--map-root-user"]):
        if subprocess.run(["unshare", *options, "true"], capture_output=True, check=False).returncode == 0:
            break
    else:
        pytest.skip("this system permits no mounts")
    (tmp_path / "volume").mkdir()
    process = Fork(use_a_mount_point, root, tmp_path / "volume", output=tmp_path / "log")
    assert process.wait() == 0, (tmp_path / "log").read_text()


def test_unusual_places(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(DatasetExistsError, match="broken link"):
        keep(root, [0], tmp_path / "loop")
    long = tmp_path / ("x" * 250)  # too long for a hidden folder beside it
    shutil.copytree(root, long)
    delete(long, [1])
    assert len(content(long)) == 2
    line = record(tmp_path / "two\nlines", [0, 1])
    delete(line, [0])
    assert len(content(line)) == 1
    monkeypatch.chdir(tmp_path / "two\nlines")
    shutil.rmtree(tmp_path / "two\nlines")
    delete(long, [0])  # from a current folder that is gone
    assert len(content(long)) == 1
    (tmp_path / "left/.bhd/compact/build").mkdir(parents=True)  # of an attempt that was killed
    with support.create(tmp_path / "left") as recorder:
        support.record(recorder)
        with pytest.raises(DatasetLockedError):
            RootLock(tmp_path / "left")
    assert support.read_back(tmp_path / "left") == 1


def test_files_that_another_program_creates_at_the_place_stay(root, tmp_path, monkeypatch):
    move = Disk.move
    places = (tmp_path / "new", tmp_path / "empty", tmp_path / "fixed")
    for place in places:
        if place.name != "new":
            place.mkdir()

        def late(self: Disk, source: Path, target: Path, place: Path = place) -> None:
            if target in (place, place / atomic.WORK / "new"):
                (place / "meta").mkdir(parents=True)
                (place / "meta/theirs").touch()
            move(self, source, target)

        with monkeypatch.context() as patch:
            patch.setattr(Disk, "move", late)
            if place.name == "fixed":
                patch.setattr(atomic, "is_fixed", lambda path: path.name == "fixed")
            with pytest.raises(DatasetError):
                keep(root, [0], place)
        assert (place / "meta/theirs").exists()
        assert not (place / "meta/info.json").exists()


def test_workspaces_of_killed_processes_only_are_removed(root: Path) -> None:
    (root.parent / ".d.bhd-0a1b2c3_/d/data").mkdir(parents=True)
    (root.parent / ".d.bhd-notes").mkdir()  # of somebody else
    living = root.parent / ".d.bhd-00000000"
    living.mkdir()
    lock = RootLock(living)
    delete(root, [1])
    assert leftovers(root.parent) == [".d.bhd-00000000", ".d.bhd-notes"]
    lock.release()
    assert not repair(root)
    assert leftovers(root.parent) == [".d.bhd-notes"]


def half_moved(root: Path) -> None:
    """Leave a dataset as a process does that is killed between the renames of an edit."""
    new = root / atomic.WORK / "new"
    other = root.with_name("other")
    shutil.copytree(root, other)
    delete(other, [1])
    shutil.copytree(other / "meta", new / "meta")
    shutil.copytree(other / "data", new / "data")
    shutil.rmtree(other)
    (root / atomic.WORK / "old").mkdir()
    (root / "data").rename(root / atomic.WORK / "old/data")
    inodes = {name: (new / name).stat().st_ino for name in ("meta", "data")}
    plan = {"root": root.stat().st_ino, "new": inodes, "goes": [], "is_new": False}
    (root / atomic.WORK / "ready").write_text(json.dumps(plan))


@pytest.mark.parametrize(
    "read",
    [
        dataset_info,
        check_dataset,
        open_metadata,
        lambda root: merge([root, record(root.with_name("e"), [5])], root.with_name("all")),
        lambda root: split(root, {"a": [0], "b": [1]}, root.with_name("parts")),
        lambda root: main.main(["info", str(root)]),
        lambda root: main.main(["export", str(root), "--output", str(root.with_name("bags"))]),
        lambda root: main.main(["repair", str(root)]),
    ],
    ids=["info", "check", "loader", "merge", "split", "bhd-data info", "export", "repair"],
)
def test_the_next_command_completes_the_change_and_reports_it(root: Path, read, caplog, capsys) -> None:
    half_moved(root)
    with caplog.at_level(logging.WARNING):
        read(root)
    assert len(content(root)) == 2
    assert "completed" in caplog.text + capsys.readouterr().out
    assert leftovers(root.parent) == []


def test_a_change_of_a_living_process_is_locked(root: Path) -> None:
    half_moved(root)
    lock = RootLock(root)
    with pytest.raises(DatasetLockedError, match="Wait until it ends"):
        dataset_info(root)
    lock.release()


@pytest.mark.parametrize("how", ["of another folder", "a path", "a link", "a link to the staging folder", "no JSON"])
def test_a_foreign_marker_moves_nothing(root: Path, how: str) -> None:
    victim = root.parent / "victim"
    (victim / "meta").mkdir(parents=True)
    half_moved(root)
    (root / atomic.WORK / "old/data").rename(root / "data")
    plan = {"root": root.stat().st_ino, "new": {}, "goes": [], "is_new": False}
    if how == "of another folder":
        plan |= {"root": 1, "goes": ["data"]}
    elif how == "a path":
        plan |= {"goes": ["../victim"]}
    elif how == "a link":
        shutil.rmtree(root / atomic.WORK / "new")
        (root / atomic.WORK / "new").symlink_to(victim)
    elif how == "a link to the staging folder":
        (root / ".bhd").rename(root / "elsewhere")
        (root / ".bhd").symlink_to("elsewhere")
    (root / atomic.WORK / "ready").write_text("{" if how == "no JSON" else json.dumps(plan))
    before = names(root.parent)
    for command in ("info", "check", "repair"):
        assert main.main([command, str(root)]) == 2
    assert main.main(["delete", str(root), "--episodes=0"]) == 2
    assert names(root.parent) == before


class KilledError(Exception):
    pass


def killed(report: object) -> None:
    raise KilledError


def test_an_edit_that_was_not_reported_is_recognised(root: Path, tmp_path: Path, capsys) -> None:
    """With the numbers of another state, the next one would delete a good episode."""
    first, _, last = content(root)
    with pytest.raises(KilledError):
        delete(root, [1], killed)
    assert main.main(["delete", str(root), "--episodes=1"]) == 0
    assert "interrupted before, after it had been completed: nothing was changed now" in capsys.readouterr().out
    assert content(root) == [first, last]
    assert main.main(["delete", str(root), "--episodes=1"]) == 0  # now it is meant
    assert content(root) == [first]

    with pytest.raises(KilledError):
        delete(record(tmp_path / "e", [0, 1, 2]), [1], killed)
    unreported = json.loads((tmp_path / "e" / layout.UNREPORTED).read_text())
    (root / layout.UNREPORTED).write_text(json.dumps({**unreported, "time": "2001"}))  # it is not about this content
    mark(root, [0], outcome="success")

    with pytest.raises(KilledError):
        mark(root, [0], outcome="failure", note="why", on_done=killed)
    assert mark(root, [0], outcome="failure", note="why").is_repeated
    assert not mark(root, [0], outcome="failure", note="why").is_repeated


@pytest.mark.parametrize(
    "other",
    [
        lambda root: delete(root, [0]),
        lambda root: mark(root, [0], outcome="failure"),
        lambda root: keep(root, [0], root.with_name("kept")),
        lambda root: split(root, {"a": [0], "b": [1]}, root.with_name("parts")),
    ],
    ids=["delete", "mark", "filter", "split"],
)
def test_after_an_unreported_edit_other_episode_numbers_are_refused_once(root: Path, other) -> None:
    with pytest.raises(KilledError):
        delete(root, [1], killed)
    before = names(root)
    with pytest.raises(DatasetError, match="had been completed"):
        other(root)
    assert names(root) == [name for name in before if name != layout.UNREPORTED]
    assert len(content(root)) == 2
    other(root)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_are_deferred(root: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    seen: list[int] = []
    former = signal.signal(number, lambda got, frame: seen.append(len(content(root))))
    swap = Disk.swap

    def disturbed(self: Disk, one: Path, other: Path) -> None:
        signal.raise_signal(number)
        assert seen == []
        swap(self, one, other)
        signal.raise_signal(number)
        assert seen == []

    try:
        monkeypatch.setattr(Disk, "swap", disturbed)
        delete(root, [1])
    finally:
        signal.signal(number, former)
    assert seen == [2]


def test_an_error_with_ctrl_c_reports_a_decided_change(root: Path, monkeypatch, capsys) -> None:
    def refuse(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(Disk, "swap", refuse)
        assert main.main(["delete", str(root), "--episodes=1"]) == 2
    message = capsys.readouterr().err
    assert "The change is committed, and the next command completes it." in message
    assert "nothing was changed" not in message
    assert main.main(["info", str(root), "--short"]) == 0
    assert len(content(root)) == 2
