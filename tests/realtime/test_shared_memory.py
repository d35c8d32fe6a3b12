"""Blocks of shared memory: found by name, and removed after their last holder, however their holders ended."""

import contextlib
import os
import random
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.realtime import shared_memory
from bhd_lerobot.realtime.block import LiveBlock, LiveLayout
from bhd_lerobot.realtime.shared_memory import SharedBlock, check_platform, names, sweep
from tests.forks import Fork
from tests.waiting import until


@pytest.fixture
def name() -> Iterator[str]:
    yield f"test-{os.getpid()}"
    sweep()


def files(name: str) -> list[Path]:
    return list(shared_memory.FOLDER.glob(f"{shared_memory.PREFIX}{name}.*"))


def hold_block(name: str, is_new: bool, begin: Path) -> None:
    """Hold a block until this process is killed; say whether that was possible."""
    until(begin.exists, "it may begin")
    try:
        block = SharedBlock.create(name, {"a": 8}, {}) if is_new else SharedBlock.attach(name)
        block.section("a")[0] = 7
        print("made", flush=True)
    except RealtimeError as error:
        print(error, flush=True)
    time.sleep(600)


def held(name: str, folder: Path, *, is_new: bool = True, count: int = 1) -> Iterator[tuple[Fork, str]]:
    """Yield processes that hold a block, and what they said, all of which began at once."""
    number = len(list(folder.iterdir()))
    begin, logs = folder / f"begin{number}", [folder / f"log{number}_{k}" for k in range(count)]
    processes = [Fork(hold_block, name, is_new, begin, output=log) for log in logs]
    begin.touch()
    for process, log in zip(processes, logs, strict=True):
        until(lambda log=log: log.read_text().endswith("\n"), "it has tried")
        yield process, log.read_text()


def test_sections_are_separate_zeroed_and_shared(name: str) -> None:
    block = SharedBlock.create(name, {"a": 10, "b": 100}, {"robot": "ur5", "names": ["é"]})
    (path,) = files(name)
    assert (path.stat().st_uid, path.stat().st_mode & 0o777) == (os.geteuid(), 0o600)  # it is private
    other = SharedBlock.attach(name)
    assert other.about == {"robot": "ur5", "names": ["é"]}
    a, b = np.frombuffer(block.section("a"), np.uint8), np.frombuffer(other.section("b"), np.uint8)
    assert (len(a), len(b)) == (10, 100)
    assert not a.any()
    assert not b.any()
    np.frombuffer(other.section("a"), np.uint8)[:] = 5
    assert (a == 5).all()
    assert not b.any()
    with pytest.raises(RealtimeError, match=f"'nobody'.*Running: .*{name}"):
        SharedBlock.attach("nobody")
    block.close()
    assert name in names()
    other.close()
    other.close()
    assert name not in names()
    assert not files(name)


def test_a_block_survives_its_maker_and_is_swept_after_its_last_holder(name: str, tmp_path: Path) -> None:
    [(maker, _)] = held(name, tmp_path)
    [(other, _)] = held(name, tmp_path, is_new=False)
    maker.kill()
    assert sweep() == []
    with pytest.raises(RealtimeError, match="running already"):
        SharedBlock.create(name, {"a": 8}, {})
    other.kill()
    assert len(files(name)) == 1
    assert name not in names()
    assert name in sweep()
    assert not files(name)


def test_a_process_that_was_forked_keeps_no_block_that_its_maker_leaves(name: str) -> None:
    block = SharedBlock.create(name, {"a": 8}, {})
    command = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=(block._descriptor,)):
        block.close()
        assert name not in names()
        SharedBlock.create(name, {"a": 8}, {}).close()


def test_what_cannot_be_is_refused(name: str) -> None:
    for bad in ("", "a/b", "../x", "a b", "x" * 200):
        with pytest.raises(ConfigError, match="cannot be called"):
            SharedBlock.create(bad, {"a": 8}, {})
    with pytest.raises(RealtimeError, match="No room"):
        SharedBlock.create(name, {"a": 1 << 50}, {})
    assert name not in names()
    assert not files(name)
    path = shared_memory.FOLDER / f"{shared_memory.PREFIX}{name}.{'0' * 16}"
    path.touch(0o600)
    for content in (b"", b"something else entirely"):
        path.write_bytes(content)
        with pytest.raises(RealtimeError, match="not a block"):
            SharedBlock.attach(name)
    path.unlink()
    for machine, system in (("i686", "Linux"), ("x86_64", "Darwin"), ("riscv64", "Linux")):
        with pytest.raises(RealtimeError, match="lockstep"):
            check_platform(machine, system)


def plant(path: Path, kind: str, content: bytes) -> bool:
    """Put a file of another program into the folder; return whether this user can do that."""
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to("/etc/hostname")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    else:
        path.write_bytes(content)
        path.chmod(0o666 if kind == "open to all" else 0o600)
    if kind == "of another user" and os.geteuid():
        path.unlink()
        return False
    if not os.geteuid():
        os.chown(path, 65534 if kind != "open to all" else -1, -1, follow_symlinks=False)
    return True


def test_files_of_others_are_neither_read_nor_removed(name: str) -> None:
    """The folder is shared by all users; a block is known by its owner, its kind and its mode, and not by its name."""
    real = SharedBlock.create(name, {"a": 8}, {"robot": "real"})
    content = files(name)[0].read_bytes()
    for kind in ("folder", "pipe", "link", "socket", "open to all", "of another user"):
        for at, planted in enumerate((f"{name}-x", f"{name}-x.{'0' * 16}", f"{name}.{'0' * 16}", name)):
            path = shared_memory.FOLDER / f"{shared_memory.PREFIX}{planted}"
            if not plant(path, kind, content.replace(b"real", b"fake")):
                continue
            try:
                assert f"{name}-x" not in names()
                assert sweep() == []
                with pytest.raises(RealtimeError, match="No running robot"):
                    SharedBlock.watch(f"{name}-x")
                with pytest.raises(RealtimeError, match="No running robot"):
                    SharedBlock.attach(f"{name}-x")
                block = SharedBlock.create(f"{name}-x", {"a": 8}, {})
                block.close()
                watched = SharedBlock.watch(name)
                assert watched.about == {"robot": "real"}, (kind, at)
                watched.close()
                assert os.path.lexists(path)
            finally:
                path.rmdir() if kind == "folder" else path.unlink()
    real.close()


def test_blocks_of_killed_runs_are_removed_and_live_blocks_stay(name: str, tmp_path: Path) -> None:
    old = shared_memory.FOLDER / f"{shared_memory.PREFIX}{name}-old"  # as version 0.1 called it
    other = shared_memory.FOLDER / f"{shared_memory.PREFIX}{name}-notes"  # another program's
    [(dead, _)], [(living, _)] = (list(held(f"{name}-{what}", tmp_path)) for what in "dl")
    try:
        (left,) = files(f"{name}-d")
        shutil.copy(left, old)
        with contextlib.suppress(FileNotFoundError):  # whoever makes a block meanwhile removes it
            old.chmod(0o600)
        dead.kill()
        other.write_text("mine")
        other.chmod(0o600)
        block = SharedBlock.create(name, {"a": 8}, {})
        assert not left.exists()
        assert not old.exists()
        assert other.exists()
        assert f"{name}-l" in names()
        attached = SharedBlock.attach(f"{name}-l")
        assert attached.section("a")[0] == 7
        attached.close()
        block.close()
    finally:
        living.kill()
        other.unlink(missing_ok=True)


def test_of_several_simultaneous_creators_at_most_one_gets_the_name(name: str, tmp_path: Path) -> None:
    processes, replies = zip(*held(name, tmp_path, count=4), strict=True)
    assert replies.count("made\n") <= 1
    assert len(files(name)) == replies.count("made\n")
    assert all("running already" in line or line == "made\n" for line in replies), replies
    for process in processes:
        process.kill()


def test_a_damaged_description_is_an_error_of_ours_and_nothing_stays_open(name: str) -> None:
    rng, opened = random.Random(0), 0
    made = LiveLayout(np.dtype([("x", np.float64)]), 4).create(name, {})
    [path] = files(name)
    intact = path.read_bytes()[:600]
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(200):
        damaged = bytearray(intact)
        size = rng.choice((1, 8, 100))
        at = rng.randrange(8, 500)
        damaged[at : at + size] = rng.randbytes(size)
        with path.open("r+b") as file:
            file.write(damaged)
        for open_it in (LiveBlock.attach, LiveBlock.watch):
            try:
                open_it(made.name).close()
                opened += 1
            except RealtimeError:
                pass
    assert opened < 200
    assert len(os.listdir("/proc/self/fd")) == before
    with path.open("r+b") as file:
        file.write(intact)
    LiveBlock.attach(made.name).close()
    made.close()
