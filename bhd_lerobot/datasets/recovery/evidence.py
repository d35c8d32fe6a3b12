"""The rows that can still be read in ``meta/episodes`` of a corrupted dataset."""

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
from bhd_lerobot.datasets.recovery.videos import FoundEpisode

_OURS = re.compile(rb"(?<=bhd/)[a-z][a-z0-9_]*(?![a-zA-Z0-9_])")
"""Names of our columns in the bytes of a footer."""


class EpisodeRows:
    """Rows and statistics of the episodes of sessions that were finished.

    Attributes:
        metadata_types: Arrow types of our columns, by name without prefix.
        torn: names without prefix of our columns in files that cannot be read.
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
                # All of it is computed anew, but for our columns and those of other programs.
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

    def complete(self, recovered: Sequence[FoundEpisode], rows: Sequence[Row]) -> None:
        """Copy our columns and those of other programs into the new rows."""
        for episode, row in zip(recovered, rows, strict=True):
            old = self.rows.get(episode.number, {}) if episode.has_row else {}
            row |= {PREFIX + name: old.get(PREFIX + name) for name in self.metadata_types}
            row |= {name: old.get(name) for name in self.extra_types}

    def stats_of(self, recovered: Sequence[FoundEpisode]) -> list[dict[str, dict[str, np.ndarray]]]:
        """Return the stored statistics of each episode; empty where there are none."""
        return [self._stats.get(episode.number, {}) if episode.has_row else {} for episode in recovered]
