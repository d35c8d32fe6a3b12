"""Which files hold some episodes, and the note that a folder has only those."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.state import corrupt
from bhd_lerobot.datasets.remote.listing import SUBSET, parse_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import to_json
from bhd_lerobot.errors import DatasetError


@dataclass(frozen=True)
class Subset:
    """Some episodes of a dataset.

    Attributes:
        episodes: their numbers, ascending.
        files: the data and video files that hold them, relative to the dataset.
    """

    episodes: list[int]
    files: set[str]


def files_of(root: Path, episodes: Sequence[int]) -> set[str]:
    """Return the data and video files that hold some episodes, by the metadata in `root`.

    Raises:
        DatasetError: there is no such episode.
        DatasetCorruptError: the metadata cannot be read.
    """
    try:
        info = parse_info((root / layout.INFO).read_bytes(), str(root))
        rows = [row for path in _tables(root) for row in _rows(path)]
        by_index = {row["episode_index"]: row for row in rows}
    except (OSError, ValueError, KeyError) as error:
        raise corrupt(root / layout.INFO, error) from error
    unknown = [episode for episode in episodes if episode not in by_index]
    if lost := [episode for episode in unknown if 0 <= episode < info["total_episodes"]]:
        reason = f"info.json counts {info['total_episodes']} episodes, but episode {lost[0]} is not described"
        raise corrupt(root / "meta/episodes", reason)
    if unknown:
        raise DatasetError(
            f"There is no episode {', '.join(map(str, unknown[:5]))}; the dataset has {len(by_index)}, from 0 to "
            f"{len(by_index) - 1}."
        )
    patterns = {"data": info.get("data_path") or layout.DATA_PATH}
    for key, feature in info["features"].items():
        if feature["dtype"] == "video":
            patterns[f"videos/{key}"] = (info.get("video_path") or layout.VIDEO_PATH).replace("{video_key}", key)
    try:
        return {
            pattern.format(chunk_index=row[f"{kind}/chunk_index"], file_index=row[f"{kind}/file_index"])
            for row in (by_index[episode] for episode in episodes)
            for kind, pattern in patterns.items()
        }
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise corrupt(root / "meta/episodes", f"it does not say which files hold an episode ({error!r})") from error


@dataclass(frozen=True)
class SubsetNote:
    """What `SUBSET` says.

    Attributes:
        episodes: the episodes that were asked for, ascending.
        is_whole: whether the folder holds all files of the dataset nevertheless.
    """

    episodes: list[int]
    is_whole: bool


def read_subset(root: Path) -> SubsetNote:
    """Return what `SUBSET` says; no episode and not whole if it is not there or cannot be read."""
    try:
        note = json.loads((root / SUBSET).read_bytes())
        return SubsetNote(sorted(int(one) for one in note["episodes"]), note.get("whole") is True)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return SubsetNote([], False)


def subset_note(source: str, note: SubsetNote) -> bytes:
    """Return the content of `SUBSET` for a dataset that came from somewhere."""
    return to_json({"source": source, "episodes": note.episodes, "whole": note.is_whole})


def _tables(root: Path) -> list[Path]:
    return sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet"))


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        names = [
            name
            for name in pq.read_schema(path).names
            if name == "episode_index" or name.endswith(("/chunk_index", "/file_index"))
        ]
        rows: list[dict[str, Any]] = pq.read_table(path, columns=names).to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise corrupt(path, error) from error
    return rows
