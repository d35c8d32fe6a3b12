"""What the readable files of ``meta/episodes`` of a corrupted dataset still tell."""

import contextlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.episode_table import PREFIX, read_stats
from bhd_lerobot.datasets.format.expected import repeated, wrong_row
from bhd_lerobot.datasets.format.state import UNREADABLE, Row, column_types
from bhd_lerobot.datasets.format.statistics import Stats
from bhd_lerobot.datasets.recovery.videos import Found

_OURS = re.compile(rb"(?<=bhd/)[a-z][a-z0-9_]*(?![a-zA-Z0-9_])")
"""Names of our columns in the bytes of a footer."""


class EpisodeRows:
    """Rows and statistics of the episodes of sessions that were finished.

    Attributes:
        rows: by the number of the episode.
        metadata_types: Arrow types of our columns, by name without prefix.
        extra_types: Arrow types of columns of other programs.
        torn: names without prefix of columns of ours that files tell which cannot be read.

    Args:
        root: the corrupted dataset.
    """

    def __init__(self, root: Path) -> None:
        self.rows: dict[int, Row] = {}
        self.metadata_types: dict[str, pa.DataType] = {}
        self.extra_types: dict[str, pa.DataType] = {}
        self.torn: set[str] = set()
        self._stats: dict[int, dict[str, Stats]] = {}
        for path in sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet")):
            try:
                file = pq.ParquetFile(path, page_checksum_verification=True)
                light = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                rows = file.read(columns=light, use_threads=False).to_pylist()
                stats = read_stats(file)
                if wrong := repeated(file.schema_arrow):
                    raise ValueError(wrong)
            except UNREADABLE:
                # Nothing is lost by it that is not made anew, but for what only we or other programs tell.
                with contextlib.suppress(OSError):
                    self.torn |= {name.decode() for name in _OURS.findall(path.read_bytes())}
                continue
            own, extra = column_types(file.schema_arrow)
            self.metadata_types = {**own, **self.metadata_types}
            self.extra_types = {**extra, **self.extra_types}
            for place, row in enumerate(rows):
                if wrong_row(row, ()):
                    continue
                self.rows[row["episode_index"]] = row
                self._stats[row["episode_index"]] = {
                    key: {name: values[place] for name, values in stat.items()} for key, stat in stats.items()
                }

    def complete(self, kept: Sequence[Found], rows: Sequence[Row]) -> None:
        """Write into the new rows what is told about their episodes by us and by other programs."""
        for one, row in zip(kept, rows, strict=True):
            old = self.rows.get(one.number, {}) if one.has_row else {}
            row |= {PREFIX + name: old.get(PREFIX + name) for name in self.metadata_types}
            row |= {name: old.get(name) for name in self.extra_types}

    def stats_of(self, kept: Sequence[Found]) -> list[dict[str, dict[str, np.ndarray]]]:
        """Return the stored statistics of each episode; empty where there are none."""
        return [self._stats.get(one.number, {}) if one.has_row else {} for one in kept]
