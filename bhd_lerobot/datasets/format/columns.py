"""Columns of episodes, straight from their Parquet files, and the order in which frames have to lie in these.

LeRobot takes frame i of a dataset for row i of all data files, sorted by their paths. Where files, or the rows in one,
are in another order than their numbers, it serves frames of other episodes and reports nothing. Readers of this package
go by the numbers.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.expected import is_listed, wrong_values
from bhd_lerobot.datasets.format.state import (
    UNREADABLE,
    DatasetState,
    Row,
    corrupt,
    load_state,
    read_frames,
    slot_of,
)
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError

NUMBERS = ("episode_index", "frame_index", "index")


def numbers_of(rows: Sequence[Row]) -> dict[str, NDArray[np.int64]]:
    """Return the numbers that the frames of a data file have to have, in order, each of shape (frames,)."""
    lengths = np.array([row["length"] for row in rows], np.int64)
    frame = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return {
        "episode_index": np.repeat([row["episode_index"] for row in rows], lengths),
        "frame_index": frame,
        "index": np.repeat([row["dataset_from_index"] for row in rows], lengths) + frame,
    }


def order_of(table: pa.Table, wanted: Mapping[str, NDArray[np.int64]]) -> NDArray[np.intp] | None:
    """Return the rows of a data file in the order of their numbers; None if it does not hold these frames.

    `index` follows from the others. It need not be right where they are in order, and else says whether they are to be
    believed.
    """
    got = {key: table[key].to_numpy() for key in NUMBERS}
    if all(np.array_equal(got[key], wanted[key]) for key in ("episode_index", "frame_index")):
        return np.arange(len(table))
    order = np.lexsort((got["frame_index"], got["episode_index"]))
    is_permuted = all(np.array_equal(got[key][order], wanted[key]) for key in NUMBERS)
    return order if is_permuted else None


def in_order(table: pa.Table, rows: Sequence[Row], path: Path) -> pa.Table:
    """Return frames in the order of their numbers; the table itself if they are."""
    wanted = numbers_of(rows)
    order = order_of(table, wanted)
    if order is None:
        raise corrupt(path, wrong_number(table, wanted))
    return table if np.array_equal(order, np.arange(len(table))) else table.take(order)


def wrong_number(table: pa.Table, wanted: Mapping[str, NDArray[np.int64]]) -> str:
    """Return the first number that is not what it has to be, as text; empty if all are."""
    frames = len(wanted["index"])
    if len(table) != frames:
        return f"it has {len(table)} frames; its episodes have {frames}"
    for key, values in wanted.items():
        got = table[key].to_numpy()
        wrong = np.flatnonzero(got != values)
        if len(wrong):
            row = wrong[0]
            return f"{key} is {got[row]} in row {row}, where meta/episodes has {values[row]}"
    return ""


def frames_of(path: Path, rows: Sequence[Row], columns: Sequence[str] | None = None) -> dict[int, pa.Table]:
    """Return the frames of each episode of a data file, by its number."""
    table = read_frames(path, None if columns is None else list(dict.fromkeys((*NUMBERS, *columns))))
    table = in_order(table, rows, path)
    starts = np.cumsum([0, *(row["length"] for row in rows)]).tolist()
    return {
        row["episode_index"]: table.slice(start, row["length"]) for row, start in zip(rows, starts[:-1], strict=True)
    }


def instructions_of(row: Row, task_index: NDArray[np.int64], tasks: Sequence[str], path: Path) -> list[str]:
    """Return the instructions of the frames of an episode, each once, in the order in which its row names them.

    If it does not name the same, in the order in which its frames have them.

    Args:
        task_index: number of the instruction of each frame, shape (T,).
    """
    numbers, first = np.unique(task_index, return_index=True)
    if numbers[0] < 0 or numbers[-1] >= len(tasks):
        what = f"episode {row['episode_index']} has an instruction that {layout.TASKS} does not have"
        raise corrupt(path, what)
    words = list(dict.fromkeys(tasks[number] for number in numbers[np.argsort(first)]))
    return row["tasks"] if set(row["tasks"]) == set(words) else words


def wrong_order(slots: Sequence[layout.Slot]) -> str:
    """Return in which way the data files do not have the order of the episodes; empty if they do."""
    names = [layout.data_file(slot) for slot in slots]
    for episode in range(1, len(names)):
        if names[episode] < names[episode - 1]:
            return (
                f"episode {episode} lies in {names[episode]}, which comes before {names[episode - 1]} of episode "
                f"{episode - 1}"
            )
    return ""


def read_episode(root: Path | str, index: int) -> dict[str, NDArray]:
    """Return every column of an episode but its videos, by key, each of shape (frames, ...)."""
    return next(read_episodes(root, [index]))


def read_episodes(root: Path | str, indices: Iterable[int]) -> Iterator[dict[str, NDArray]]:
    """Yield every column of episodes as `read_episode` returns them, one episode at a time."""
    state = load_state(Path(root))
    features = state.info["features"]
    for index in indices:
        table = episode_frames(state, row_of(state, index))
        yield {
            key: to_numpy(table[key], tuple(features[key]["shape"])) for key in table.column_names if key in features
        }


def row_of(state: DatasetState, index: int) -> Row:
    """Return the row of an episode in ``meta/episodes``."""
    count = state.num_episodes
    if not 0 <= index < count:
        valid = f", from 0 to {count - 1}" if count else ""
        raise DatasetError(f"There is no episode {index} in {state.root}; it has {count}{valid}.")
    return state.rows[index]


def episode_frames(state: DatasetState, row: Row, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the frames of an episode in the order of their numbers, all columns or some."""
    path = state.root / layout.data_file(slot_of(row, "data"))
    try:
        table = pq.read_table(
            path,
            columns=None if columns is None else list(dict.fromkeys((*columns, *NUMBERS))),
            filters=[("episode_index", "=", row["episode_index"])],
            page_checksum_verification=True,
        )
    except UNREADABLE as error:
        raise corrupt(path, error) from error
    if wrong := wrong_values(table):
        raise corrupt(path, wrong)
    return in_order(table, [row], path)


def flat(column: pa.ChunkedArray) -> pa.Array:
    """Return the values of a column; those of lists one after the other."""
    array = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # of no rows
        array = pa.concat_arrays(array.chunks)
    while isinstance(array, pa.ExtensionArray) or is_listed(array.type):
        array = array.storage if isinstance(array, pa.ExtensionArray) else array.flatten()
    return array


def numbers(column: pa.ChunkedArray) -> NDArray | None:
    """Return the numbers of a column, flat; None if it holds something else."""
    array = flat(column)
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    return array.to_numpy(zero_copy_only=False) if any(is_one(array.type) for is_one in kinds) else None


def to_numpy(column: pa.ChunkedArray, shape: tuple[int, ...] = (-1,)) -> NDArray:
    """Return a column of a data file as an array of shape (T, *shape), or (T,) of scalars."""
    array = flat(column)
    if pa.types.is_struct(array.type):  # language: a list of rows for every frame
        rows = np.empty(len(column), dtype=object)
        rows[:] = column.to_pylist()
        return rows
    values = np.asarray(array.to_numpy(zero_copy_only=False))
    return values.reshape(len(column), *shape) if is_listed(column.type) else values


def video_frames(path: Path, start_s: float, count: int) -> Iterator[NDArray[np.uint8]]:
    """Yield `count` images of a video from `start_s` [s] on, each of shape (H, W, 3)."""
    import av

    found = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            base, rate = stream.time_base, stream.average_rate
            assert base is not None
            assert rate is not None
            half = 0.5 / float(rate)
            first = start_s - half + (stream.start_time or 0) * float(base)
            container.seek(max(0, int(first / float(base))), stream=stream)
            for frame in container.decode(stream):
                if frame.pts is not None and frame.pts * float(base) < first:
                    continue
                yield np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                found += 1
                if found == count:
                    return
    except (av.error.FFmpegError, IndexError) as error:
        raise corrupt(path, error) from error
    raise corrupt(path, f"it ends {count - found} images before its episode does")
