"""Small bags that would unpack to any size: refused with a message, within the memory that their size explains."""

import json
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import lz4.frame
import pytest
from backports import zstd

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage import unpack
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.bag.storage.unpack import Budget
from tests.ros2.bag.support import drive, write

MIB = 1 << 20
MAGIC = b"\x89MCAP0\r\n"
COMPRESS = {"zstd": zstd.compress, "lz4": lz4.frame.compress, "": bytes}

# What reads the bags: with as much memory as it has at the beginning, and 300 MiB. Sizes that may be unpacked are made
# small, so that the bombs need not be large.
CHILD = """
import json, resource, sys
from pathlib import Path
from bhd_lerobot.ros2.bag.storage import unpack
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.errors import BhdError
unpack.LEAST_BYTES = 32 << 20
unpack.zstd()
import lz4.frame, tempfile, sqlite3
sqlite3.connect(":memory:").close()
pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (pages + (300 << 20),) * 2)
if sys.argv[1] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
if sys.argv[2]:
    tempfile.tempdir = sys.argv[2]
results = {}
for path in map(Path, sys.argv[3:]):
    try:
        (bag,) = find_bags(path)
        found = bag.topics
        read = bag.read(["/scan"])
        results[path.name] = f"{len(found)} topics, {len(read['/scan'].data)} messages; {bag.problems}"
    except BhdError as error:
        results[path.name] = f"error: {error}"
    except MemoryError as error:
        results[path.name] = "memory"
    except BaseException as error:
        results[path.name] = f"{type(error).__name__}: {error}"
print(json.dumps(results))
"""


def read_in_bounds(paths: Iterable[Path], file_bytes: int = 0, folder: str = "") -> dict[str, str]:
    """Return what a process with little memory reads of bags, or its error, by their names."""
    command = [sys.executable, "-c", CHILD, str(file_bytes), folder, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def chunk(content: bytes, compression: str, declared: int | None = None) -> bytes:
    packed = COMPRESS[compression](content)
    head = struct.pack("<QQQI", 0, 0, len(content) if declared is None else declared, 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


def message(payload: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + payload)


CHANNELS = record(3, struct.pack("<H", 1) + text("a/msg/B") + text("ros2msg") + text("")) + record(
    4, struct.pack("<HH", 1, 1) + text("/scan") + text("cdr") + struct.pack("<I", 0)
)


def mcap(path: Path, *parts: bytes) -> Path:
    path.write_bytes(MAGIC + record(1, text("ros2") + text("")) + CHANNELS + b"".join(parts) + record(15, bytes(4)))
    return path


def database(path: Path, *statements: str, rows: Iterable[bytes] = ()) -> Path:
    """Write a SQLite bag; without a statement of its own, with messages as rosbag2 has them."""
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA page_size = 1024")
        connection.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
            "offered_qos_profiles TEXT)"
        )
        connection.execute("INSERT INTO topics VALUES (1, '/scan', 'a/msg/B', 'cdr', '')")
        for statement in statements or (
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)",
        ):
            connection.execute(statement)
        for row in rows:
            connection.execute("INSERT INTO messages VALUES (NULL, 1, 1, ?)", (row,))
    connection.close()
    return path


def test_a_bomb_is_an_error_and_takes_no_memory(tmp_path: Path) -> None:
    large = message(bytes(16 * MIB))
    bombs = [
        *(mcap(tmp_path / f"chunks_{how}.mcap", *[chunk(large, how)] * 40) for how in ("zstd", "lz4")),
        *(mcap(tmp_path / f"one_{how}.mcap", chunk(large * 40, how)) for how in ("zstd", "lz4")),
        mcap(tmp_path / "empty_messages.mcap", *[chunk(message(b"") * 300_000, "zstd")] * 20),
        mcap(tmp_path / "packed_messages.mcap", *[message(zstd.compress(bytes(16 * MIB)))] * 40),
        database(tmp_path / "packed.db3", rows=[zstd.compress(bytes(16 * MIB))] * 40),
    ]
    whole = tmp_path / "whole.mcap.zstd"
    whole.write_bytes(zstd.compress(bytes(640 * MIB)))
    bombs.append(whole)
    assert max(path.stat().st_size for path in bombs if "lz4" not in path.name) < 200_000
    for name, result in read_in_bounds(bombs).items():
        if "lz4" in name:  # which makes 255 times the size at most
            continue
        assert result.startswith("error: "), (name, result)
        for part in (str(tmp_path / name), "unpacks to more than", "MiB", "take the compression away first"):
            assert part in result, (name, result)


def test_sizes_that_lie_are_damage(tmp_path: Path) -> None:
    content = message(b"x" * 1000)
    bags = [
        mcap(tmp_path / "less.mcap", chunk(message(bytes(400 * MIB)), "zstd", 100), chunk(content, "zstd")),
        mcap(tmp_path / "more.mcap", chunk(content, "zstd", 1 << 62), chunk(content, "zstd")),
        mcap(tmp_path / "more_lz4.mcap", chunk(content, "lz4", 1 << 62), chunk(content, "lz4")),
    ]
    for name, result in read_in_bounds(bags).items():
        assert result.startswith("1 topics, 1 messages"), (name, result)
        assert "its checksum or size is wrong; left out" in result, (name, result)


def test_texts_that_reach_beyond_their_record(tmp_path: Path) -> None:
    """Each topic of a file would be named after all of it."""
    channels = [record(4, struct.pack("<HHI", number, 1, 2 * MIB)) for number in range(2, 2000)]
    result = read_in_bounds([mcap(tmp_path / "texts.mcap", *channels, bytes(2 * MIB))])["texts.mcap"]
    assert "it has a damaged record" in result


ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, 1 AS timestamp"
)
TABLE = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB"


def same_page(path: Path) -> Path:
    """Return a database whose table has one page many times."""
    database(path, rows=[bytes(900)] * 80)
    with sqlite3.connect(path) as connection:
        (root,) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    connection.close()
    content = bytearray(path.read_bytes())
    at = (root - 1) * 1024
    kind, _, cells = struct.unpack_from(">BHH", content, at)
    assert (kind, cells > 50) == (5, True)
    places = struct.unpack_from(f">{cells}H", content, at + 12)
    (leaf,) = struct.unpack_from(">I", content, at + places[0])
    for place in (*places, 8):
        struct.pack_into(">I", content, at + place, leaf)
    last = max(leaf, root)
    struct.pack_into(">I", content, 28, last)
    path.write_bytes(content[: last * 1024])
    return path


def test_rows_that_are_computed(tmp_path: Path) -> None:
    decoy = (
        "PRAGMA writable_schema = ON",
        "CREATE TABLE decoy(id INTEGER)",
        f"UPDATE sqlite_master SET sql = 'CREATE VIEW messages AS {ENDLESS}, zeroblob(9) AS data FROM n', rootpage = 0 "
        "WHERE name = 'decoy'",
    )
    bags = {
        "view": database(tmp_path / "view.db3", f"CREATE VIEW messages AS {ENDLESS}, zeroblob(100) AS data FROM n"),
        "view of nothing": database(tmp_path / "none.db3", f"CREATE VIEW messages AS {ENDLESS}, NULL AS data FROM n"),
        "decoy": database(tmp_path / "decoy.db3", *decoy),
        "topics": database(
            tmp_path / "topics.db3",
            "DROP TABLE topics",
            f"CREATE VIEW topics AS {ENDLESS}, 'x' AS name, 'y' AS type, 'cdr' AS serialization_format FROM n",
            f"{TABLE})",
        ),
        "computed": database(
            tmp_path / "computed.db3",
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB AS (zeroblob(400000000)))",
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
        ),
        "virtual": database(tmp_path / "virtual.db3", "CREATE VIRTUAL TABLE messages USING rtree(id, a, b)"),
        "pages": same_page(tmp_path / "pages.db3"),
    }
    results = read_in_bounds(bags.values())
    for what, path in bags.items():
        wanted = "and its rows have more" if what == "pages" else "which computes rows instead of holding them"
        assert results[path.name].startswith(f"error: {path}"), (what, results)
        assert wanted in results[path.name], (what, results)


def test_metadata_that_grow_when_they_are_written_out(tmp_path: Path) -> None:
    aliases = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 10)
    )
    usual = {"relative_file_paths": "[b.mcap]", "message_count": "1", "topics_with_message_count": "[]"}
    bags = []
    for name, changed in {
        "files": {"relative_file_paths": "*a9"},
        "mode": {"compression_mode": "*a9"},
        "topics": {"topics_with_message_count": "[{topic_metadata: {name: *a9}}]"},
        "count": {"message_count": "*a9"},
        "deep": {"message_count": "[" * 5000},
    }.items():
        folder = tmp_path / name
        folder.mkdir()
        mcap(folder / "b.mcap", message(b"x"))
        values = "".join(f"  {key}: {value}\n" for key, value in {**usual, **changed}.items())
        (folder / "metadata.yaml").write_text(f"{aliases}rosbag2_bagfile_information:\n{values}")
        bags.append(folder)
    for name, result in read_in_bounds(bags).items():
        assert result.startswith("1 topics, 1 messages"), (name, result)


def test_a_full_temporary_folder_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    packed = tmp_path / "packed.mcap.zstd"
    packed.write_bytes(zstd.compress(mcap(tmp_path / "plain.mcap", message(bytes(8 * MIB))).read_bytes()))
    cut = database(tmp_path / "cut.db3", rows=[bytes(1000)] * 8000)
    cut.write_bytes(cut.read_bytes()[:-100])
    assert all("1 topics" in result for result in read_in_bounds([packed, cut]).values())
    for limit, folder in ((MIB, ""), (0, str(tmp_path / "nowhere"))):
        before = set(tmp_path.iterdir())
        for name, result in read_in_bounds([packed, cut], limit, folder or str(tmp_path)).items():
            assert result.startswith(f"error: {tmp_path / name} cannot be unpacked into {folder or tmp_path}"), result
            assert "Free some space there, or name another folder in the environment variable TMPDIR" in result
        assert set(tmp_path.iterdir()) == before  # the folders are gone, too


def test_the_bound_grows_with_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording that compresses well, as that of a robot that stands still, is read."""
    monkeypatch.setattr(unpack, "LEAST_BYTES", 0)
    whole = write(tmp_path / "b", drive(seconds=20)) / "b.mcap"
    packed = tmp_path / "b.mcap.zstd"
    packed.write_bytes(zstd.compress(whole.read_bytes()))
    found, wanted = (find_bags(path)[0].read(["/scan"])["/scan"].data for path in (packed, whole))
    assert found == wanted
    budget = Budget(packed)
    budget.take(budget.left)
    with pytest.raises(DatasetError, match="unpacks to more than"):
        budget.take(1)
    budget.start()
    budget.take(200 * packed.stat().st_size)
