"""Which files hold some episodes, and the note that a folder has only those."""

import json
from collections.abc import Sequence
from pathlib import Path

from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.remote.listing import SUBSET
from bhd_lerobot.datasets.storage.disk import to_json
from bhd_lerobot.errors import DatasetError


def files_of(root: Path, episodes: Sequence[int]) -> set[str]:
    """Return the files that hold some episodes, by the metadata in `root`."""
    state = load_state(root, files=False)
    if unknown := [episode for episode in episodes if not 0 <= episode < state.num_episodes]:
        raise DatasetError(
            f"There is no episode {', '.join(map(str, unknown[:5]))}; the dataset has {state.num_episodes}, from 0 to "
            f"{state.num_episodes - 1}."
        )
    return state.files(episodes)


def is_subset(root: Path) -> bool:
    """Return whether a folder has only some files of a dataset."""
    return (root / SUBSET).exists()


def subset_episodes(root: Path) -> list[int]:
    """Return the episodes that were requested, ascending; none without a note, or if it cannot be read."""
    try:
        return sorted(int(one) for one in json.loads((root / SUBSET).read_bytes())["episodes"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return []


def subset_note(source: str, episodes: Sequence[int]) -> bytes:
    """Return the content of `SUBSET` for some episodes of a dataset that came from somewhere."""
    return to_json({"source": source, "episodes": list(episodes)})
