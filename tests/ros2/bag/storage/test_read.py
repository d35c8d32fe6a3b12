"""Bags as they are found: any storage, any compression, several files, and every kind of damage."""

import os
import shutil
import sqlite3
import tempfile
from pathlib import Path

import pytest
from backports import zstd
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.find import find_bags
from tests.ros2.bag.support import STORE, TOPICS, check, drive, write


@pytest.fixture(scope="module")
def messages():
    return drive(seconds=3)


@pytest.fixture(scope="module")
def bags(tmp_path_factory, messages):
    folder = tmp_path_factory.mktemp("bags")
    return {storage: write(folder / storage, messages, storage) for storage in ("mcap", "sqlite3")}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_both_storages_read_back_also_as_a_bare_file(bags, messages, storage):
    assert check(bags[storage], messages) == len(messages)
    (file,) = (one for one in bags[storage].iterdir() if one.suffix in (".mcap", ".db3"))
    assert check(file, messages) == len(messages)


@pytest.mark.parametrize(
    ("mode", "storage"),
    [("FILE", "MCAP"), ("FILE", "SQLITE3"), ("MESSAGE", "SQLITE3"), ("MESSAGE", "MCAP"), ("STORAGE", "MCAP")],
)
def test_compressed_bags(tmp_path, messages, mode, storage):
    assert check(write(tmp_path / "b", messages, storage, mode), messages) == len(messages)
    if mode == "MESSAGE":
        (tmp_path / "b" / "metadata.yaml").unlink()
        guessed = "its messages are compressed one by one (compression_mode: MESSAGE)"
        assert check(tmp_path / "b", messages, "no metadata.yaml", guessed) == len(messages)


def write_mcap(path: Path, messages, compression, *, use_chunking: bool = True, chunk_size: int = 20_000) -> Path:
    """Write a file as another writer does."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, compression=compression)
        writer._writer._Writer__use_chunking = use_chunking
        schemas = {}
        for topic, received, message in messages:
            kind = message.__msgtype__
            if kind not in schemas:
                text, _ = STORE.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_msgdef(kind, text)
            fields = STORE.serialize_cdr(message, kind)
            channel = writer._channel_ids.get(topic)
            if channel is None:
                channel = writer._channel_ids[topic] = writer._writer.register_channel(topic, "cdr", schemas[kind].id)
            writer._writer.add_message(channel, received, bytes(fields), received)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("use_chunking", [True, False])
def test_files_of_another_writer(tmp_path, messages, compression, use_chunking):
    path = write_mcap(tmp_path / "other.mcap", messages, compression, use_chunking=use_chunking)
    assert check(path, messages) == len(messages)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_the_chunk_of_a_writer_that_was_killed_is_read_as_one_that_was_cut(tmp_path, messages, compression):
    """Until it closes a chunk, foxglove-sdk's writer has all ones in place of lengths, size and checksum."""
    whole = bytearray(write_mcap(tmp_path / "other.mcap", messages, compression, chunk_size=60_000).read_bytes())
    place, chunks = 8, []
    while whole[place] != 0x0F:  # to the end of the data
        chunks += [place] if whole[place] == 0x06 else []
        place += 9 + int.from_bytes(whole[place + 1 : place + 9], "little")
    assert len(chunks) > 1
    last, ones = chunks[-1], b"\xff" * 8
    end = last + 9 + int.from_bytes(whole[last + 1 : last + 9], "little")
    name = int.from_bytes(whole[last + 37 : last + 41], "little")
    counts = []
    for size in (last + 60, (last + end) // 2, end - 1):
        cut = bytearray(whole[:size])
        path = tmp_path / "cut.mcap"
        path.write_bytes(cut)
        counts.append(check(path, messages, "", whole=False))
        for at, length in ((last + 1, 8), (last + 25, 8), (last + 33, 4), (last + 41 + name, 8)):
            cut[at : at + length] = ones[:length]
        path.write_bytes(cut)
        assert check(path, messages, "", whole=False) == counts[-1]
    assert counts[0] < counts[-1] or compression is CompressionType.ZSTD  # whose blocks are larger than this chunk


def test_a_bag_that_is_cut_off_anywhere_gives_what_is_before_or_is_refused(tmp_path, bags, messages):
    whole = (bags["mcap"] / "mcap.mcap").read_bytes()
    path, last = tmp_path / "cut.mcap", 0
    for size in [*range(0, len(whole), len(whole) // 60), *range(len(whole) - 400, len(whole), 7)]:
        path.write_bytes(whole[:size])
        if size < 8:
            with pytest.raises(DatasetError, match=r"cut\.mcap"):
                check(path, messages)
            continue
        complete = whole.index(b"\x0f\x04\0\0\0\0\0\0\0") + 13 <= size  # the end of the data is there
        last = max(last, check(path, messages, *[""] * (not complete), whole=False))
    assert last == len(messages)


def test_a_cut_compressed_chunk_gives_what_can_be_decompressed(tmp_path, messages):
    path = write(tmp_path / "b", [one for one in messages if one[0] == "/scan"], "mcap", "STORAGE") / "b.mcap"
    path.write_bytes(path.read_bytes()[:2000])
    (bag,) = find_bags(tmp_path / "b")
    read = bag.read(["/scan"])
    assert len(bag.problems) == 1
    assert len(read["/scan"].data) < 15


def test_a_damaged_chunk_is_left_out_and_reported(tmp_path, messages):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=1000, compression=CompressionType.NONE)
        schema = writer.register_msgdef("std_msgs/String", "string data")
        for number in range(100):
            writer.write_message("/s", schema, {"data": f"number {number:03d}"}, log_time=number)
        writer.finish()
    content = bytearray(path.read_bytes())
    content[content.index(b"number 050")] ^= 1
    path.write_bytes(content)
    (bag,) = find_bags(path)
    read = bag.read(["/s"])["/s"]
    assert len(bag.problems) == 1
    assert "checksum" in bag.problems[0]
    assert 0 < len(read.data) < 100
    assert {0, 99} <= set(read.received.tolist())


def test_a_damaged_database_gives_what_is_before_or_is_refused(tmp_path, bags, messages):
    whole = (bags["sqlite3"] / "sqlite3.db3").read_bytes()
    path = tmp_path / "cut.db3"
    totals = []
    for share in (0.5, 0.7, 0.9):
        path.write_bytes(whole[: int(len(whole) * share)])
        totals.append(check(path, messages, "", whole=False))
    assert 0 < totals[0] < totals[1] < totals[2] < len(messages)
    for size in (0, 200, 5000):
        path.write_bytes(whole[:size])
        with pytest.raises(DatasetError, match=r"cut\.db3"):
            find_bags(path)[0].read(TOPICS)


def test_a_database_of_gigabytes_is_read(tmp_path, bags, messages):
    path = tmp_path / "large.db3"
    shutil.copy(bags["sqlite3"] / "sqlite3.db3", path)
    os.truncate(path, 3 << 30)  # of which nothing is on the disk
    assert check(path, messages) == len(messages)


@pytest.fixture
def logged(bags):
    """Return a folder that everybody may read, with a bag whose second half is in its write-ahead log."""
    with tempfile.TemporaryDirectory() as name:
        work, folder = Path(name, "work.db3"), Path(name, "b")
        shutil.copy(bags["sqlite3"] / "sqlite3.db3", work)
        folder.mkdir()
        connection = sqlite3.connect(work, isolation_level=None)
        rows = connection.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
        connection.execute("DELETE FROM messages WHERE id > 20")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[20:])
        for ending in ("", "-wal"):
            shutil.copy(f"{work}{ending}", f"{folder / 'b.db3'}{ending}")
        connection.close()
        Path(name).chmod(0o755)
        yield folder


@pytest.mark.parametrize("by_link", [False, True])
def test_the_write_ahead_log_of_a_killed_recorder_is_read_and_nothing_is_left_behind(
    tmp_path, logged, messages, by_link, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    bag = logged / "b.db3"
    before = {path.name: path.read_bytes() for path in logged.iterdir()}
    if by_link:
        bag = tmp_path / "link.db3"
        bag.symlink_to(logged / "b.db3")
    assert check(bag, messages) == len(messages)
    assert {path.name: path.read_bytes() for path in logged.iterdir()} == before
    assert not list(tmp_path.glob("bhd-bag-*"))


def test_a_write_ahead_log_is_read_where_nothing_can_be_written(logged, messages):
    logged.chmod(0o555)
    user = os.geteuid()
    try:
        if user == 0:  # who may write everywhere
            os.seteuid(65534)
    except OSError:
        pytest.skip("no other user in this namespace")
    try:
        assert not os.access(logged, os.W_OK, effective_ids=True)
        assert check(logged / "b.db3", messages) == len(messages)
    finally:
        os.seteuid(user)
        logged.chmod(0o755)


def test_messages_that_the_file_lacks_and_torn_metadata_are_reported(tmp_path, bags, messages):
    shutil.copytree(bags["sqlite3"], tmp_path / "b")
    with sqlite3.connect(tmp_path / "b" / "sqlite3.db3") as connection:
        connection.execute("DELETE FROM messages WHERE id > 50")
    (bag,) = find_bags(tmp_path / "b")
    bag.read(TOPICS)
    with Reader(bags["sqlite3"]) as reader:
        assert f"count {reader.message_count} messages; it has 50" in bag.problems[0]
    shutil.copytree(bags["mcap"], tmp_path / "torn")
    text = (tmp_path / "torn" / "metadata.yaml").read_text()
    (tmp_path / "torn" / "metadata.yaml").write_text(text[: len(text) // 2] + "\n\t: [")
    assert check(tmp_path / "torn", messages, "metadata.yaml") == len(messages)


def test_what_is_no_bag_is_refused(tmp_path, bags):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "no.mcap").write_bytes(b"")
    (tmp_path / "no.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    lacking = tmp_path / "lacking"
    shutil.copytree(bags["mcap"], lacking)
    (lacking / "mcap.mcap").unlink()
    for name in ("none", "empty", "notes.txt", "lacking"):
        with pytest.raises(DatasetError, match=name):
            find_bags(tmp_path / name)
    packed = zstd.compress((bags["mcap"] / "mcap.mcap").read_bytes())
    for size in (5, len(packed) // 2):
        (tmp_path / f"{size}.mcap.zstd").write_bytes(packed[:size])
        with pytest.raises(DatasetError, match="zstd"):
            find_bags(tmp_path / f"{size}.mcap.zstd")[0].read(TOPICS)
    for name in ("no.mcap", "no.db3"):
        with pytest.raises(DatasetError, match=name):
            find_bags(tmp_path / name)[0].read(TOPICS)
