"""Whole columns of one episode, straight from its Parquet file."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.state import corrupt, load_state, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError


def read_episode(root: Path | str, index: int) -> dict[str, NDArray]:
    """Return every column of an episode but its videos, by key, each of shape (frames, ...).

    Args:
        root: the dataset.
        index: the episode.

    Raises:
        DatasetError: there is no such dataset or episode.
        DatasetCorruptError: the file cannot be read.
    """
    root = Path(root)
    state = load_state(root)
    if not 0 <= index < state.num_episodes:
        raise DatasetError(
            f"There is no episode {index} in {root}; it has {state.num_episodes}, from 0 to {state.num_episodes - 1}."
        )
    path = root / layout.data_file(slot_of(state.rows[index], "data"))
    try:
        table = pq.read_table(path, filters=[("episode_index", "=", index)], page_checksum_verification=True)
    except (OSError, pa.ArrowInvalid) as error:
        raise corrupt(path, error) from error
    return {
        key: _to_numpy(table[key], tuple(state.info["features"][key]["shape"]))
        for key in table.column_names
        if key in state.info["features"]
    }


def _to_numpy(column: pa.ChunkedArray, shape: tuple[int, ...]) -> NDArray:
    array = column.combine_chunks()
    if pa.types.is_list(array.type) and pa.types.is_struct(array.type.value_type):
        rows = np.empty(len(array), dtype=object)  # language: a list of rows for every frame
        rows[:] = array.to_pylist()
        return rows
    if pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type):
        return array.flatten().to_numpy(zero_copy_only=False).reshape(len(array), *shape)
    return np.asarray(array.to_numpy(zero_copy_only=False))
