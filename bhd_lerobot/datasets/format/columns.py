"""Columns of episodes, straight from their Parquet files: all of one episode, or a few of many."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.state import (
    DatasetState,
    Row,
    corrupt,
    load_state,
    ordered_slots,
    read_frames,
    slot_of,
)
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
    present = [key for key in keys if key in state.info["features"]]
    rows = state.rows if episode is None else [_row(state, episode)]
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


def read_episode(root: Path | str, index: int) -> dict[str, NDArray]:
    """Return every column of an episode but its videos, by key, each of shape (frames, ...).

    Args:
        root: the dataset.
        index: the episode.

    Raises:
        DatasetError: there is no such dataset or episode.
        DatasetCorruptError: the file cannot be read.
    """
    return next(read_episodes(root, [index]))


def read_episodes(root: Path | str, indices: Iterable[int]) -> Iterator[dict[str, NDArray]]:
    """Yield every column of episodes as `read_episode` returns them, one episode at a time.

    Raises:
        DatasetError: there is no such dataset or episode.
        DatasetCorruptError: a file cannot be read.
    """
    root = Path(root)
    state = load_state(root)
    for index in indices:
        path = root / layout.data_file(slot_of(_row(state, index), "data"))
        try:
            table = pq.read_table(path, filters=[("episode_index", "=", index)], page_checksum_verification=True)
        except (OSError, pa.ArrowInvalid) as error:
            raise corrupt(path, error) from error
        yield {
            key: _to_numpy(table[key], tuple(state.info["features"][key]["shape"]))
            for key in table.column_names
            if key in state.info["features"]
        }


def _row(state: DatasetState, index: int) -> Row:
    count = state.num_episodes
    if not 0 <= index < count:
        valid = f", from 0 to {count - 1}" if count else ""
        raise DatasetError(f"There is no episode {index} in {state.root}; it has {count}{valid}.")
    return state.rows[index]


def _to_numpy(column: pa.ChunkedArray, shape: tuple[int, ...]) -> NDArray:
    array = column.combine_chunks()
    if pa.types.is_list(array.type) and pa.types.is_struct(array.type.value_type):
        rows = np.empty(len(array), dtype=object)  # language: a list of rows for every frame
        rows[:] = array.to_pylist()
        return rows
    if pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type):
        return array.flatten().to_numpy(zero_copy_only=False).reshape(len(array), *shape)
    return np.asarray(array.to_numpy(zero_copy_only=False))


def video_frames(path: Path, start_s: float, count: int) -> Iterator[NDArray[np.uint8]]:
    """Yield images of a video, each of shape (H, W, 3).

    Args:
        path: the video.
        start_s: time of the first one [s].
        count: how many.

    Raises:
        DatasetCorruptError: the video cannot be read, or ends before.
    """
    import av

    found = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            base, rate = stream.time_base, stream.average_rate
            assert base is not None
            assert rate is not None
            half = 0.5 / float(rate)
            container.seek(max(0, int((start_s - half) / float(base))), stream=stream)
            for frame in container.decode(stream):
                if frame.pts is not None and frame.pts * float(base) < start_s - half:
                    continue
                yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                found += 1
                if found == count:
                    return
    except (av.error.FFmpegError, IndexError) as error:
        raise corrupt(path, error) from error
    raise corrupt(path, f"it ends {count - found} images before its episode does")
