"""SQLite files of rosbag2, read in the order in which messages were written, also damaged ones."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetError


class SqliteFile:
    """One file.

    Attributes:
        channels: number -> topic, type, serialisation.
        problems: what could not be read, in sentences.

    Args:
        path: the file.

    Raises:
        DatasetError: it is no bag, or not even its list of topics can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        try:
            # With a write-ahead log beside it, which a killed recorder leaves, the log is read, too.
            has_log = path.with_name(f"{path.name}-wal").exists()
            options = "mode=ro" if has_log else "mode=ro&immutable=1"
            self._connection = sqlite3.connect(f"{path.resolve().as_uri()}?{options}", uri=True)
            rows = self._connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.Error as error:
            raise DatasetError(
                f"{path} cannot be read as a bag ({error}): even its list of topics is lost. Restore it from a copy, "
                "or try `sqlite3 BAG .recover`."
            ) from error
        self.channels: dict[int, tuple[str, str, str]] = {number: (a, b, c) for number, a, b, c in rows}

    def close(self) -> None:
        """Give the file back."""
        self._connection.close()

    def summary(self) -> dict[int, int] | None:
        """Return how many messages each topic has; None if that cannot be counted."""
        try:
            rows = self._connection.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall()
        except sqlite3.Error:
            return None
        return dict.fromkeys(self.channels, 0) | dict(rows)

    def messages(self) -> Iterator[tuple[int, int, Any, int, int]]:
        """Yield topic, receive time [ns], and where its bytes lie: a buffer, first and last; as they were written."""
        self.problems = []
        count = 0
        try:
            for channel, received, data in self._connection.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                count += 1
                yield channel, received, data, 0, len(data)
        except sqlite3.Error as error:
            self.problems.append(
                f"{self.path.name}: after {count} messages it cannot be read any more ({error}); what is before is read"
            )
