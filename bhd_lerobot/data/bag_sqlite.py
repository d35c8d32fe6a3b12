"""SQLite files of rosbag2, read in the order in which messages were written, also damaged ones."""

import contextlib
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bhd_lerobot.data.bag_qos import offered
from bhd_lerobot.errors import DatasetError


class SqliteFile:
    """One file.

    Attributes:
        channels: number -> topic, type, serialisation.
        publishers: number -> how many offered the topic, where the recorder wrote it.
        problems: what could not be read, in sentences.

    Args:
        path: the file.

    Raises:
        DatasetError: it is no bag, or not even its list of topics can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        whole = self._whole_pages(path)
        try:
            # With a write-ahead log beside it, which a killed recorder leaves, the log is read, too.
            has_log = path.with_name(f"{path.name}-wal").exists()
            options = "mode=ro" if has_log else "mode=ro&immutable=1"
            self._connection = sqlite3.connect(f"{whole.resolve().as_uri()}?{options}", uri=True)
            # Without it SQLite does not open a file that has fewer pages than its header says. Nothing is written.
            self._connection.execute("PRAGMA writable_schema = ON")
            rows = self._connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.Error as error:
            raise DatasetError(
                f"{path} cannot be read as a bag ({error}): even its list of topics is lost. Restore it from a copy, "
                "or try `sqlite3 BAG .recover`."
            ) from error
        self.channels: dict[int, tuple[str, str, str]] = {number: (a, b, c) for number, a, b, c in rows}
        self.publishers: dict[int, int] = {}
        with contextlib.suppress(sqlite3.Error):  # rosbag2's first versions have no such column
            rows = self._connection.execute("SELECT id, offered_qos_profiles FROM topics").fetchall()
            self.publishers = {number: offered(profiles) for number, profiles in rows}

    def close(self) -> None:
        """Give the file back."""
        self._connection.close()
        if self._copy is not None:
            self._copy.cleanup()

    def _whole_pages(self, path: Path) -> Path:
        """Return the file, or, if it ends within a page, a copy without that: SQLite would read zeros for the rest."""
        with path.open("rb") as file:
            head = file.read(18)
        page = (int.from_bytes(head[16:18]) or 4096) if len(head) == 18 else 4096
        page = 65536 if page == 1 else page  # so the format says it
        size = path.stat().st_size
        if size < page or not size % page:
            return path
        self._copy = tempfile.TemporaryDirectory(prefix="bhd-bag-")
        copy = Path(self._copy.name) / path.name
        shutil.copyfile(path, copy)
        os.truncate(copy, size - size % page)
        return copy

    def summary(self) -> dict[int, int] | None:
        """Return how many messages each topic has; None if that cannot be counted."""
        try:
            # Without it SQLite does not open a file that has fewer pages than its header says. Nothing is written.
            self._connection.execute("PRAGMA writable_schema = ON")
            rows = self._connection.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall()
        except sqlite3.Error:
            return None
        return dict.fromkeys(self.channels, 0) | dict(rows)

    def messages(self) -> Iterator[tuple[int, int, Any, int, int]]:
        """Yield topic, receive time [ns], and where its bytes lie: a buffer, first and last; as they were written."""
        self.problems = []
        count = 0
        self._connection.text_factory = bytes  # of a damaged row, bytes may be taken for a text
        try:
            for channel, received, data in self._connection.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                count += 1
                # Of a damaged row a value may be of any type: it has no possible time, or cannot be decoded.
                payload = data if isinstance(data, bytes) else b""
                yield channel, received if isinstance(received, int) else -1, payload, 0, len(payload)
        except sqlite3.Error as error:
            self.problems.append(
                f"{self.path.name}: after {count} messages it cannot be read any more ({error}); what is before is read"
            )
