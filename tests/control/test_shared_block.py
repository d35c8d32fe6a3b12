"""Blocks of shared memory: found by name, and gone when nobody holds them any more, however their holders ended."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from bhd_lerobot.control import shared_block
from bhd_lerobot.control.shared_block import SharedBlock, check_platform, names, sweep
from bhd_lerobot.errors import ConfigError, RealtimeError

HOLD = """
import sys, time
from bhd_lerobot.control.shared_block import SharedBlock
block = SharedBlock.{how}
memory = block.section("a")
memory[0] = 7
print("ready", flush=True)
time.sleep(60)
"""


@pytest.fixture
def name() -> Iterator[str]:
    yield f"test-{os.getpid()}"
    sweep()


def hold(name: str, how: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HOLD.format(how=how)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_sections_are_separate_zeroed_and_seen_by_whoever_attaches(name: str) -> None:
    block = SharedBlock.create(name, {"a": 10, "b": 100}, {"robot": "ur5", "names": ["é"]})
    other = SharedBlock.attach(name)
    assert other.about == {"robot": "ur5", "names": ["é"]}
    a, b = np.frombuffer(block.section("a"), np.uint8), np.frombuffer(other.section("b"), np.uint8)
    assert (len(a), len(b)) == (10, 100)
    assert not a.any()
    assert not b.any()
    np.frombuffer(other.section("a"), np.uint8)[:] = 5
    assert (a == 5).all()
    assert not b.any()
    assert names() == [name] or name in names()
    block.close()
    assert name in names()
    other.close()
    other.close()
    assert name not in names()
    assert not (shared_block.FOLDER / f"{shared_block.PREFIX}{name}").exists()


def test_a_name_is_taken_as_long_as_anybody_holds_it(name: str) -> None:
    process = hold(name, f"create({name!r}, {{'a': 8}}, {{}})")
    try:
        with pytest.raises(RealtimeError, match="running already"):
            SharedBlock.create(name, {"a": 8}, {})
    finally:
        kill(process)
    SharedBlock.create(name, {"a": 8}, {}).close()


def test_a_kill_of_the_maker_leaves_it_to_the_others_and_a_kill_of_all_leaves_rubbish_that_is_swept(name: str) -> None:
    maker = hold(name, f"create({name!r}, {{'a': 8}}, {{}})")
    other = hold(name, f"attach({name!r})")
    kill(maker)
    assert sweep() == []
    with pytest.raises(RealtimeError, match="running already"):
        SharedBlock.create(name, {"a": 8}, {})
    kill(other)
    path = shared_block.FOLDER / f"{shared_block.PREFIX}{name}"
    assert path.exists()
    assert name not in names()
    assert name in sweep()
    assert not path.exists()


def test_attaching_to_what_does_not_run_names_what_does(name: str) -> None:
    block = SharedBlock.create(name, {"a": 8}, {})
    with pytest.raises(RealtimeError, match=f"'nobody'.*Running: .*{name}"):
        SharedBlock.attach("nobody")
    block.close()


@pytest.mark.parametrize("bad", ["", "a/b", "../x", "a b", "x" * 200])
def test_names_that_are_no_names_are_refused(bad: str) -> None:
    with pytest.raises(ConfigError, match="cannot be called"):
        SharedBlock.create(bad, {"a": 8}, {})


def test_no_room_is_said_before_anything_is_used(name: str) -> None:
    with pytest.raises(RealtimeError, match="No room"):
        SharedBlock.create(name, {"a": 1 << 50}, {})
    assert name not in names()
    assert not (shared_block.FOLDER / f"{shared_block.PREFIX}{name}").exists()


def test_a_file_that_is_no_block_is_refused(name: str) -> None:
    path = shared_block.FOLDER / f"{shared_block.PREFIX}{name}"
    for content in (b"", b"something else entirely"):
        path.write_bytes(content)
        with pytest.raises(RealtimeError, match="not a block"):
            SharedBlock.attach(name)
    path.unlink()


@pytest.mark.parametrize(("machine", "system"), [("aarch64", "Linux"), ("x86_64", "Darwin"), ("riscv64", "Linux")])
def test_other_platforms_are_refused_with_the_way_out(machine: str, system: str) -> None:
    with pytest.raises(RealtimeError, match="lockstep"):
        check_platform(machine, system)


def test_this_platform_is_one_that_was_checked() -> None:
    check_platform("x86_64", "Linux")
    assert time.monotonic_ns() > 0
