"""SQLite files of rosbag2, read in the order in which messages were written, also damaged ones."""

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.unpack import Budget, room, temporary_copy

_STEPS = 10_000  # of SQLite's own machine, between two checks of their number
_LOGS = ("-wal", "-journal")
_LEAST_STEPS, _STEPS_PER_BYTE = 10_000_000, 20
_MOST_LENGTH = 2**31 - 1  # [bytes] of a value: what SQLite's limit can be set to


class SqliteFile:
    """One file."""

    def __init__(self, path: Path, budget: Budget | None = None) -> None:
        self.path = path
        self.budget = budget or Budget(path)
        self.problems: list[str] = []
        self._stack = contextlib.ExitStack()
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise

    def _open(self) -> None:
        whole = self._whole_pages()
        # With a write-ahead log or a rollback journal beside it, which a killed recorder leaves, that is read, too.
        logs = [Path(f"{self.path.resolve()}{ending}") for ending in _LOGS]
        logs = [log for log in logs if log.exists() and log.stat().st_size]
        if logs:
            whole = self._beside_logs(whole, logs)
        self._bytes = whole.stat().st_size + sum(log.stat().st_size for log in logs)
        try:
            connection = sqlite3.connect(
                f"{whole.resolve().as_uri()}?mode={'rw' if logs else 'ro&immutable=1'}", uri=True
            )
            self._connection = self._stack.enter_context(contextlib.closing(connection))
            self._bound()
            # Without it SQLite does not open a file that has fewer pages than its header counts. Nothing is written.
            self._connection.execute("PRAGMA writable_schema = ON")
            self._refuse_computed()
            rows = list(self._rows("SELECT id, name, type, serialization_format FROM topics"))
        except sqlite3.Error as error:
            raise DatasetError(
                f"{self.path} cannot be read as a bag ({error}): even its list of topics is lost. Restore it from a "
                "copy, or try `sqlite3 BAG .recover`."
            ) from error
        self.channels: dict[int, tuple[str, str, str]] = {number: (a, b, c) for number, a, b, c in rows}
        self.profiles: dict[int, Any] = {}
        with contextlib.suppress(sqlite3.Error):  # rosbag2's first versions have no such column
            self.profiles = dict(self._rows("SELECT id, offered_qos_profiles FROM topics"))
        self.definitions: dict[str, str] = {}
        with contextlib.suppress(sqlite3.Error):  # nor has Humble's such a table
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
            self.definitions = dict(self._rows(query))

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def _bound(self) -> None:
        """Let no query take more memory or time than the file's size explains."""
        connection = self._connection
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(self._bytes, 1 << 20), _MOST_LENGTH))
        connection.execute("PRAGMA trusted_schema = OFF")
        # Pages that are linked in a circle are rows without end. SQLite's steps are counted, some ten for a row, and a
        # row has some ten bytes at least.
        left = _LEAST_STEPS + _STEPS_PER_BYTE * self._bytes

        def count() -> bool:
            nonlocal left
            left -= _STEPS
            return left < 0

        connection.set_progress_handler(count, _STEPS)

    def _refuse_computed(self) -> None:
        """Refuse a bag whose rows are not stored in it, but computed by it: they may be any number of any size."""
        for name in ("topics", "messages"):
            # As SQLite understood the schema, whose own names may say something else.
            kinds = {kind for (kind,) in self._connection.execute("SELECT type FROM pragma_table_list(?)", (name,))}
            hidden = "SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden != 0"
            if kinds - {"table"} or self._connection.execute(hidden, (name,)).fetchone()[0]:
                kind = ", ".join(sorted(kinds - {"table"})) or "table with computed columns"
                raise DatasetError(
                    f"{self.path} is no bag that a recorder wrote: its {name!r} is a {kind}, which computes rows "
                    "instead of holding them. It is not read."
                )

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Yield rows; together they have no more bytes than the file."""
        left = self._bytes
        for row in self._connection.execute(query):
            left -= sum(max(len(value), 1) if isinstance(value, str | bytes) else 1 for value in row)
            if left < 0:
                raise DatasetError(
                    f"{self.path} is damaged, or made so on purpose: it has {self._bytes} bytes, and its rows have "
                    "more. Restore it from a copy."
                )
            yield row

    def _whole_pages(self) -> Path:
        """Return the file, or, if it ends within a page, a copy without that: SQLite would read zeros for the rest."""
        path = self.path
        with path.open("rb") as file:
            head = file.read(18)
        page = (int.from_bytes(head[16:18]) or 4096) if len(head) == 18 else 4096
        page = 65536 if page == 1 else page  # 65536 does not fit into the field
        size = path.stat().st_size
        if size < page or not size % page:
            return path
        return self._stack.enter_context(temporary_copy(path, path.name, _beginning(path, size - size % page)))

    def _beside_logs(self, whole: Path, logs: list[Path]) -> Path:
        """Return a copy of the file with its logs beside it: where SQLite reads one, it writes."""
        if whole == self.path:
            whole = self._stack.enter_context(
                temporary_copy(whole, whole.name, _beginning(whole, whole.stat().st_size))
            )
        for log in logs:
            with room(self.path):
                shutil.copyfile(log, f"{whole}{log.name.removeprefix(self.path.resolve().name)}")
        return whole

    def summary(self) -> dict[int, int] | None:
        """Return how many messages each topic has; None if that cannot be counted."""
        try:
            # Without it SQLite does not open a file that has fewer pages than its header counts. Nothing is written.
            self._connection.execute("PRAGMA writable_schema = ON")
            rows = dict(self._rows("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        except sqlite3.Error:
            return None
        return dict.fromkeys(self.channels, 0) | rows

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield topic, receive time [ns] and bytes of each message, as they were written."""
        self.problems = []
        self.budget.start()
        self._bound()
        count = 0
        self._connection.text_factory = bytes  # of a damaged row, bytes may be taken for a text
        try:
            for channel, received, data in self._rows("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                count += 1
                # Of a damaged row a value may be of any type: it has no possible time, or cannot be decoded.
                yield channel, received if isinstance(received, int) else -1, data if isinstance(data, bytes) else b""
        except sqlite3.Error as error:
            self.problems.append(
                f"{self.path.name}: after {count} messages it cannot be read any more ({error}); what is before is read"
            )


def _beginning(path: Path, size: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        while size:
            block = file.read(min(size, 1 << 20))
            size -= len(block)
            yield block
