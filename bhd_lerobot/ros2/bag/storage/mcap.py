"""MCAP files, read by the `mcap` library in the order of their bytes, also those that end too early.

`rosbags` reads through the index at the end, sorted by time. A file that was cut off has none, and a clock that jumped
shows only in the order in which messages were written.
"""

import mmap
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from zlib import crc32

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.unpack import MESSAGE_BYTES, Budget

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK = b"\x06"  # what a chunk's record begins with; its length follows
_HEAD_BYTES = 9


class _Mapped(mmap.mmap):
    """A file of which a read of more bytes than there are gives those that there are, and reserves no memory for more.

    Of a chunk that its writer has not closed yet, all lengths may be the largest number of 64 bits.
    """

    def read(self, n: int | None = None) -> bytes:
        return super().read(len(self) if n is None else min(n, len(self)))


class McapFile:
    """One file.

    Attributes:
        channels: number -> topic, type, serialisation; those read so far.
        profiles: number -> quality of service of the topic's publishers, as the recorder wrote it.
        definitions: type -> its definition with those that it names; those read so far.

    Args:
        budget: how much it may unpack to; by its own size if None.
    """

    def __init__(self, path: Path, budget: Budget | None = None) -> None:
        self.path = path
        self.budget = budget or Budget(path)
        self.channels: dict[int, tuple[str, str, str]] = {}
        self.profiles: dict[int, Any] = {}
        self.definitions: dict[str, str] = {}
        self.problems: list[str] = []
        self._schemas: dict[int, str] = {0: ""}
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise DatasetError(f"{path} is no MCAP file: it does not begin as one, or is empty.")
            self._data = _Mapped(file.fileno(), 0, access=mmap.ACCESS_READ)

    def close(self) -> None:
        """Close the file."""
        self._data.close()

    def summary(self) -> dict[int, int] | None:
        """Return how many messages each channel has, from the end of the file; None where that is not written."""
        from mcap.reader import SeekingReader

        data: Any = self._data
        try:
            found = SeekingReader(data).get_summary()
        except Exception:  # whatever a parser of damaged bytes raises
            return None
        if found is None or found.statistics is None:
            return None
        for record in (*found.schemas.values(), *found.channels.values()):
            self._define(record)
        counts = found.statistics.channel_message_counts
        return counts if counts.keys() <= self.channels.keys() else None

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield channel, receive time [ns] and bytes of each message, in the file's order."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk, DataEnd, Message

        self.problems = []
        self.budget.start()
        data: Any = self._data
        data.seek(0)
        place = 0
        for record in self._records(data, "it"):
            if isinstance(record, DataEnd):
                return
            if isinstance(record, Message):
                yield record.channel_id, record.log_time, record.data
            elif isinstance(record, Chunk):
                yield from self._chunk(record, place, is_whole=True)
            else:
                self._define(record)
            place = data.tell()
        if data.tell() < len(data):
            return
        self._note(
            f"it ends at byte {len(data)} in the middle of its data, as after a crash or a cut; what is before is read"
        )
        if data[place : place + 1] == _CHUNK:
            data.seek(place + _HEAD_BYTES)
            try:
                cut = Chunk.read(ReadDataStream(data))
            except Exception:  # it is cut before its content begins
                return
            yield from self._chunk(cut, place, is_whole=False)

    def _records(self, stream: Any, what: str) -> Iterator[Any]:
        """Yield the records of the file or of a chunk, to the end of the stream or to a damaged one."""
        from mcap.stream_reader import StreamReader

        skip_magic = stream is not self._data
        records = StreamReader(stream, skip_magic, emit_chunks=True, record_size_limit=None).records
        while True:
            try:
                record = next(records)
            except Exception as error:  # whatever a parser of damaged or missing bytes raises
                if stream.read(1):
                    self._note(f"{what} has a damaged record ({error}); what is before is read")
                return
            yield record

    def _note(self, what: str) -> None:
        self.problems.append(f"{self.path.name}: {what}")

    def _chunk(self, chunk: Any, place: int, *, is_whole: bool) -> Iterator[tuple[int, int, bytes]]:
        from mcap.records import Message

        name, size, content = chunk.compression, chunk.uncompressed_size, chunk.data
        try:
            if name:
                content = self.budget.unpack(name, content, size)
        except (DatasetError, MemoryError):
            raise
        except Exception as error:  # of two libraries, and they differ in what they raise
            self._note(f"the chunk at byte {place} cannot be decompressed ({' '.join(str(error).split())}); left out")
            return
        crc = chunk.uncompressed_crc
        if is_whole and (len(content) != size or (crc and crc32(content) != crc)):
            self._note(f"the chunk at byte {place} is damaged: its checksum or size is wrong; left out")
            return
        for record in self._records(BytesIO(content), f"the chunk at byte {place}"):
            if isinstance(record, Message):
                if name:
                    self.budget.take(MESSAGE_BYTES)
                yield record.channel_id, record.log_time, record.data
            else:
                self._define(record)

    def _define(self, record: Any) -> None:
        from mcap.records import Channel, Schema

        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
            if record.encoding == "ros2msg":
                self.definitions[record.name] = record.data.decode(errors="replace")
        elif isinstance(record, Channel):
            msgtype = self._schemas.get(record.schema_id, "")
            self.channels[record.id] = (record.topic, msgtype, record.message_encoding)
            self.profiles[record.id] = record.metadata.get("offered_qos_profiles")
