"""A few columns of many episodes, without reading the others."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.state import load_state, ordered_slots, read_frames
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError


def read_columns(root: Path | str, keys: Sequence[str], episode: int | None = None) -> list[dict[str, NDArray]]:
    """Return columns of scalars, by key, of one episode or of all, each of shape (frames,).

    Args:
        root: the dataset.
        keys: the columns; those that the dataset does not have are left out.
        episode: the only episode that is wanted; all if None.

    Raises:
        DatasetError: there is no such dataset or episode.
        DatasetCorruptError: a file cannot be read.
    """
    root = Path(root)
    state = load_state(root)
    if episode is not None and not 0 <= episode < state.num_episodes:
        raise DatasetError(
            f"There is no episode {episode} in {root}; it has {state.num_episodes}"
            + (f", from 0 to {state.num_episodes - 1}." if state.num_episodes else ".")
        )
    present = [key for key in keys if key in state.info["features"]]
    rows = state.rows if episode is None else [state.rows[episode]]
    result: dict[int, dict[str, NDArray]] = {}
    for slot, inside in ordered_slots(rows, "data").items():
        path = root / layout.data_file(slot)
        table = read_frames(path, ["episode_index", *present])
        indices = np.asarray(table["episode_index"])  # in ascending order, as LeRobot's format wants it
        arrays = {key: np.asarray(table[key]) for key in present}
        for row in inside:
            index = row["episode_index"]
            first, last = np.searchsorted(indices, [index, index + 1])
            result[index] = {key: array[first:last] for key, array in arrays.items()}
    return [result[row["episode_index"]] for row in rows]
