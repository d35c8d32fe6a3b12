"""Episodes that several datasets have, because one was copied from another, filtered out of it, or recorded again."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bhd_lerobot.datasets.assembly.picks import Pick
from bhd_lerobot.datasets.format.episode_table import PREFIX, stored_stats
from bhd_lerobot.datasets.format.state import DatasetState, ordered_slots
from bhd_lerobot.datasets.storage import layout

type _Content = tuple[object, ...]

_LEARNED = ("observation", "action", "expert")  # with these, names of columns begin that a policy learns from
_TELLING = ("min", "max", "mean", "std")


def each_once(states: Sequence[DatasetState]) -> tuple[list[Pick], dict[Path, list[int]]]:
    """Return the episodes of several datasets without those that one before has, and these by their datasets."""
    picks: list[Pick] = []
    left_out: dict[Path, list[int]] = {}
    known: set[_Content] = set()
    for state in states:
        contents = _contents(state)
        for row in state.rows:
            if contents.get(row["episode_index"]) in known:
                left_out.setdefault(state.root, []).append(row["episode_index"])
            else:
                picks.append(Pick(state, row))
        known.update(contents.values())
    return picks, left_out


def _contents(state: DatasetState) -> dict[int, _Content]:
    """Return what tells each episode from others, by its number; nothing of one in which nothing changes.

    That is its instructions, its seed, and the statistics of what is learned from: to the last digit, they are those of
    no other frames. A mark does not make it another one.
    """
    contents: dict[int, _Content] = {}
    for slot, rows in ordered_slots(state.rows, "meta/episodes").items():
        order, stored = stored_stats(state.root / layout.episodes_file(slot))
        places = {index: place for place, index in enumerate(order)}
        learned = [stored[key] for key in sorted(stored) if key.startswith(_LEARNED)]
        for row in rows:
            place = places[row["episode_index"]]
            if any(stat["std"][place].any() for stat in learned):
                numbers = [np.asarray(stat[name][place], np.float64).tobytes() for stat in learned for name in _TELLING]
                contents[row["episode_index"]] = (row["length"], *row["tasks"], str(row.get(f"{PREFIX}seed")), *numbers)
    return contents
