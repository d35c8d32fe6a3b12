"""Bags that are being written: whenever and however the writer ends, what was flushed before can be read."""

import os
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from bhd_lerobot.ros2.bag.storage import crash_safe
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.bag.storage.write import BagWriter, profile
from bhd_lerobot.ros2.messages.serialize import encode_one

TEXT = "std_msgs/msg/String"
ROOM = crash_safe._ROOM // 10  # by which a file is extended here
FLUSHES, EACH, SIZE = 12, 5, 10_000  # more than that room


def write(path: Path, storage: str) -> None:
    """Write a bag, which is flushed several times."""
    with BagWriter(path, storage, {}) as bag:
        connection = bag.connect("/a", TEXT, [profile(10)])
        for number in range(FLUSHES * EACH):
            bag.append(connection, number, encode_one(TEXT, {"data": f"{number:06d}" + "x" * SIZE}))
            if number % EACH == EACH - 1:
                bag.flush()


def read(path: Path) -> list[int]:
    with Reader(path) as reader:
        return [int(bytes(data)[8:14]) for _, _, data in reader.messages()]


@pytest.mark.law
@pytest.mark.parametrize(("room", "steps"), [(ROOM, 30), (100, 54)])  # less than the file's end takes, as after hours
def test_an_mcap_file_is_complete_before_and_after_every_step_of_writing_it(room, steps, tmp_path, monkeypatch):
    bag, copy, real, flush = tmp_path / "bag", tmp_path / "copy.mcap", os.pwrite, BagWriter.flush
    monkeypatch.setattr(crash_safe, "_ROOM", room)
    taken = flushed = 0

    def pwrite(file: int, data: bytes, place: int) -> int:
        nonlocal taken
        taken += 1
        if taken > 2:  # by which the file begins
            real(file, data[: len(data) // 2] if len(data) > 100 else b"", place)  # a long one may be cut off
            shutil.copyfile(bag / "bag.mcap", copy)
            found = read(copy)
            assert found == list(range(len(found))), taken
            assert len(found) >= EACH * flushed, taken
            (ours,) = find_bags(copy)
            assert len(ours.read(["/a"])["/a"].data) == len(found), taken
        return real(file, data, place)

    def counted(self: BagWriter) -> None:
        nonlocal flushed
        flush(self)
        flushed += 1

    monkeypatch.setattr(BagWriter, "flush", counted)
    monkeypatch.setattr(os, "pwrite", pwrite)
    write(bag, "mcap")
    assert (taken, flushed) == (steps, FLUSHES)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_is_read_by_others_after_each_flush(storage: str, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, storage, {}) as bag:
        for topic, numbers in (("/a", range(3)), ("/b", range(3, 6))):
            connection = bag.connect(topic, TEXT, [profile(10)])
            for number in numbers:
                bag.append(connection, number, encode_one(TEXT, {"data": f"{number:06d}"}))
            bag.flush()
            with Reader(path) as reader:
                messages = [one.topic for one, _, _ in reader.messages()]
                assert reader.message_count == len(messages)
                assert messages[-1] == topic
                assert [one.topic for one in reader.connections][-1] == topic
            if storage == "mcap":
                with (path / "bag.mcap").open("rb") as file:
                    assert len(list(make_reader(file).iter_messages())) == len(messages)
    assert not find_bags(path)[0].problems
    assert find_bags(path)[0].topics["/b"].count == 3
    assert (path / f"bag.{'mcap' if storage == 'mcap' else 'db3'}").stat().st_size < 100_000


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("name", ["drive #1", "a%41?b", "träge"])
def test_a_bag_lies_in_the_folder_that_was_named(storage: str, name: str, tmp_path: Path) -> None:
    with BagWriter(tmp_path / name / "bag", storage, {}) as bag:
        bag.append(bag.connect("/a", TEXT, [profile(10)]), 5, encode_one(TEXT, {"data": "x"}))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert find_bags(tmp_path / name / "bag")[0].read(["/a"])["/a"].received.tolist() == [5]


def test_a_database_that_cannot_grow_is_an_error_of_the_system(tmp_path: Path) -> None:
    """Also where a topic is added, not a message."""

    def add_topics() -> None:
        with BagWriter(tmp_path / "bag", "sqlite3", {}) as bag:
            storage: Any = bag._writer.storage
            storage.conn.execute("PRAGMA max_page_count = 12")
            for number in range(1000):
                bag.connect(f"/a{number}", TEXT, [profile(10)])

    with pytest.raises(OSError, match="No space left on device"):
        add_topics()


def test_what_sqlite_had_not_committed_when_it_was_killed_is_rolled_back(tmp_path: Path) -> None:
    path, killed = tmp_path / "bag", tmp_path / "killed"
    write(path, "sqlite3")
    file = path / "bag.db3"
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("PRAGMA synchronous = OFF")
    connection.execute("UPDATE messages SET data = zeroblob(200000), topic_id = 7")  # of which pages are written early
    assert Path(f"{file}-journal").stat().st_size
    shutil.copytree(path, killed)
    connection.rollback()
    connection.close()
    (bag,) = find_bags(killed)
    assert [int(data[8:14]) for data in bag.read(["/a"])["/a"].data] == list(range(FLUSHES * EACH))
    assert Path(killed, "bag.db3-journal").exists()  # nothing is changed there
