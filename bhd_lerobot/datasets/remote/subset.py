"""Which files hold some episodes, and the note that a folder has only those."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.state import UNREADABLE, corrupt
from bhd_lerobot.datasets.remote.listing import SUBSET, parse_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import to_json
from bhd_lerobot.errors import DatasetError


def files_of(root: Path, episodes: Sequence[int]) -> set[str]:
    """Return the data and video files that hold some episodes, by the metadata in `root`.

    Raises:
        DatasetError: there is no such episode.
        DatasetCorruptError: the metadata cannot be read.
    """
    info = parse_info((root / layout.INFO).read_bytes(), str(root))
    by_index = _rows(root)
    for episode in episodes:
        if episode not in by_index and 0 <= episode < info["total_episodes"]:
            reason = f"info.json counts {info['total_episodes']} episodes, but episode {episode} is not described"
            raise corrupt(root / "meta/episodes", reason)
    if unknown := [episode for episode in episodes if episode not in by_index]:
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


def is_subset(root: Path) -> bool:
    """Return whether a folder has only some files of a dataset. The note of version 0.1 may say that it has all."""
    return (root / SUBSET).exists() and _read(root).get("whole") is not True


def subset_episodes(root: Path) -> list[int]:
    """Return the episodes that were requested, ascending; none without a note, or if it cannot be read."""
    try:
        return sorted(int(one) for one in _read(root)["episodes"])
    except (ValueError, KeyError, TypeError, OverflowError):
        return []


def subset_note(source: str, episodes: Sequence[int]) -> bytes:
    """Return the content of `SUBSET` for some episodes of a dataset that came from somewhere."""
    return to_json({"source": source, "episodes": list(episodes)})


def _read(root: Path) -> dict[str, Any]:
    try:
        note = json.loads((root / SUBSET).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _rows(root: Path) -> dict[int, dict[str, Any]]:
    rows: dict[int, dict[str, Any]] = {}
    for path in sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet")):
        try:
            names = [
                name
                for name in pq.read_schema(path).names
                if name == "episode_index" or name.endswith(("/chunk_index", "/file_index"))
            ]
            rows |= {row["episode_index"]: row for row in pq.read_table(path, columns=names).to_pylist()}
        except (*UNREADABLE, KeyError) as error:
            raise corrupt(path, error) from error
    return rows
