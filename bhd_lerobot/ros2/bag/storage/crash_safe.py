"""Files of bags that are complete after every `flush`, whenever and however their process ends, by `rosbags`' writers.

Of this package only `write` imports this module, and not before `rosbags` is known to be there.
"""

import contextlib
import errno
import json
import os
import sqlite3
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

_HEAD = struct.Struct("<BQ")  # what a record of an MCAP file begins with: its kind and its length
_UNUSED = 0x80  # of the kinds that are free for any use, and that readers skip
_END = (
    _HEAD.pack(0x0F, 4) + bytes(4)  # end of data
    + _HEAD.pack(0x02, 20) + bytes(20)  # footer, without a summary
    + b"\x89MCAP0\r\n"
)  # fmt: skip
_ROOM = 4 << 20  # that the file is extended by [bytes]; nothing is written there, so it takes no space on the disk
_MOST_UNCOMMITTED = 16 << 20  # [bytes] that SQLite keeps in memory


class _AppendedMcap:
    """An MCAP file in which a block of records appears in one step: by the 9 bytes of the head that precedes it.

    Behind what was written there is a record that readers skip, and behind that the end of the file.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY)
        self._used = self._size = os.fstat(self._file).st_size
        self._block = bytearray()
        self._extend(0)

    def write(self, data: Any) -> int:
        """Append to the block."""
        self._block += data
        return len(data)

    def tell(self) -> int:
        """Return the place that the next byte will have in the file."""
        return self._used + len(self._block)

    def flush(self) -> None:
        """Write the block, which begins and ends with a record."""
        if not self._block:
            return
        after = self.tell()
        if after + _HEAD.size + len(_END) > self._size:
            self._extend(len(self._block))
        unused = self._size - len(_END) - after - _HEAD.size
        self._put(bytes(self._block[_HEAD.size :]) + _HEAD.pack(_UNUSED, unused), self._used + _HEAD.size)
        self._appear(after)

    def close(self) -> None:
        """Write the block, which is the end of the file, and close it."""
        after = self.tell()
        if after + len(_END) > self._size:
            self._extend(len(self._block))
        self._put(bytes(self._block[_HEAD.size :]), self._used + _HEAD.size)
        os.ftruncate(self._file, after)
        self._appear(after)
        self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def _appear(self, after: int) -> None:
        self._put(bytes(self._block[: _HEAD.size]), self._used)
        self._used = after
        self._block.clear()

    def _extend(self, size: int) -> None:
        end = self._used + size + _HEAD.size + _ROOM
        self._put(_HEAD.pack(_UNUSED, end - self._used - _HEAD.size), self._used)
        self._put(_END, end)
        self._size = end + len(_END)

    def _put(self, data: bytes, place: int) -> None:
        view = memoryview(data)
        while view:
            count = os.pwrite(self._file, view, place)
            view, place = view[count:], place + count


class _Mcap(McapWriter):
    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.bio.close()
        self.bio: Any = _AppendedMcap(self.path)

    def close_chunk(self) -> None:
        super().close_chunk()
        self.bio.flush()

    def flush(self) -> None:
        if self.chunk.msgs:
            self.close_chunk()

    def abort(self) -> None:
        self.bio.abandon()


class _Sqlite(Sqlite3Writer):
    """Commits by SQLite's rollback journal; nothing of a transaction is in the file before."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        with _system_errors(path):
            # `rosbags` puts it into a URI, in which # ends a path and % begins an escape.
            super().__init__(Path(quote(os.fsencode(path))), compression)
            self.path = path / f"{path.name}.db3"
            self.conn.execute("PRAGMA synchronous = OFF")  # a process may end at any time, not the system
            self.conn.execute("PRAGMA cache_spill = OFF")
        self._uncommitted = 0

    def add_msgtype(self, connection: Any) -> None:
        with _system_errors(self.path):
            super().add_msgtype(connection)

    def add_connection(self, connection: Any, offered_qos_profiles: str) -> None:
        with _system_errors(self.path):
            super().add_connection(connection, offered_qos_profiles)

    def write(self, connection: Any, timestamp: int, data: bytes | memoryview) -> None:
        with _system_errors(self.path):
            super().write(connection, timestamp, data)
        self._uncommitted += len(data)
        if self._uncommitted > _MOST_UNCOMMITTED:
            self.flush()

    def flush(self) -> None:
        with _system_errors(self.path):
            self.conn.commit()
        self._uncommitted = 0

    def close(self, version: int, metadata: str) -> None:
        with _system_errors(self.path):
            super().close(version, metadata)


@contextlib.contextmanager
def _system_errors(path: Path) -> Iterator[None]:
    """Give SQLite's errors the form that those of other files have."""
    try:
        yield
    except sqlite3.Error as error:
        number = errno.ENOSPC if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL else errno.EIO
        raise OSError(number, f"{os.strerror(number)}, {error}", str(path)) from error


class CrashSafeWriter(Writer):
    """`rosbags`' writer, with `flush`."""

    STORAGE_PLUGINS: Mapping[StoragePlugin, Any] = {StoragePlugin.MCAP: _Mcap, StoragePlugin.SQLITE3: _Sqlite}

    def __init__(self, path: Path, storage: str, version: Literal[8, 9]) -> None:
        super().__init__(path, version=version, storage_plugin=StoragePlugin[storage.upper()])
        self._flushed = -1, -1
        self._profiles: dict[int, str] = {}  # as text, which takes long to make

    def flush(self) -> None:
        """Write what there is so far, so that the bag can be read as it is, also with a list of its topics."""
        storage: Any = self.storage
        storage.flush()
        count = sum(self.counts.values())
        if (count, len(self.connections)) == self._flushed:
            return
        self._flushed = count, len(self.connections)
        times = {
            "starting_time": {"nanoseconds_since_epoch": self.min_timestamp if count else 0},
            "duration": {"nanoseconds": max(0, self.max_timestamp - self.min_timestamp)},
            "message_count": count,
        }
        topics = [
            {
                "topic_metadata": {
                    "name": one.topic,
                    "type": one.msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": self._profiles_of(one),
                    "type_description_hash": one.digest,
                },
                "message_count": self.counts[one.id],
            }
            for one in self.connections
        ]
        name = storage.path.name
        about = {
            "version": self.version,
            "storage_identifier": self.storage_plugin.name.lower(),
            "relative_file_paths": [name],
            **times,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": name, **times}],
            "custom_data": self.custom_data or None,
            "ros_distro": "rosbags",
        }
        part = self.metapath.with_suffix(".yaml.tmp")
        part.write_text(json.dumps({"rosbag2_bagfile_information": about}), "utf-8")  # JSON is YAML, and fast
        part.replace(self.metapath)

    def _profiles_of(self, connection: Any) -> str:
        if connection.id not in self._profiles:
            self._profiles[connection.id] = dump_qos_v8(connection.ext.offered_qos_profiles)
        return self._profiles[connection.id]
