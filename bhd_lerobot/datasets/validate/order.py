"""Whether files, rows and instructions lie in the order of their numbers: LeRobot counts rows and reads no numbers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.columns import instructions_of, numbers_of, order_of, wrong_number, wrong_order
from bhd_lerobot.datasets.format.state import UNREADABLE, Row
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.validate.findings import FIX, Findings
from bhd_lerobot.errors import brief

_MOVE = "Move it out of the dataset."
SORTS = f"{FIX} puts them in order."


def check_numbers(
    path: Path, table: pa.Table, rows: Sequence[Row], tasks: Sequence[str], findings: Findings
) -> NDArray[np.intp] | None:
    """Check the numbers of the frames of a data file, and the instructions that `meta/episodes` names.

    Returns:
        The rows of the file in the order of their numbers; None if it does not hold these frames.
    """
    wanted, name = numbers_of(rows), "/".join(path.parts[-3:])
    wrong = wrong_number(table, wanted)
    order = order_of(table, wanted) if len(table) == len(wanted["index"]) else None
    if order is None:
        remedy = "Restore the file, or meta/episodes, from a copy."
        if len(table) != len(wanted["index"]):
            remedy = "bhd-data repair, or restore it from a copy."
        findings.error("counts", name, wrong, remedy)
        return None
    if (np.diff(order) < 0).any():
        findings.error("order", name, f"its rows are not in the order of their numbers: {wrong}", SORTS)
    elif wrong:
        findings.error("counts", name, wrong, f"{FIX} numbers the frames again.")
    numbers = table["task_index"].to_numpy()
    if len(tasks) and ((numbers < 0) | (numbers >= len(tasks))).any():
        first = numbers[(numbers < 0) | (numbers >= len(tasks))][0]
        what = f"task_index is {first}; there are {len(tasks)} instructions"
        findings.error("counts", name, what, "Restore meta/tasks.parquet from a copy.")
    elif len(tasks):
        _check_instructions(rows, numbers[order], tasks, path, findings)
    return order


def _check_instructions(
    rows: Sequence[Row], numbers: NDArray[np.int64], tasks: Sequence[str], path: Path, findings: Findings
) -> None:
    """Compare the instructions of the frames with those that the rows of their episodes name."""
    ends = np.cumsum([row["length"] for row in rows])
    others = [
        (row, words)
        for row, own in zip(rows, np.split(numbers, ends[:-1]), strict=True)
        if (words := instructions_of(row, own, tasks, path)) != row["tasks"]
    ]
    for row, words in others[:1]:
        episodes = brief(row["episode_index"] for row, _ in others)
        what = (
            f"the instructions of episode {row['episode_index']} are {brief(map(repr, row['tasks'])) or 'missing'}, "
            f"and its frames have {brief(map(repr, words))}; so of {episodes}"
        )
        findings.error("counts", "meta/episodes", what, f"{FIX} lists those of the frames.")


def check_order(root: Path, slots: Sequence[layout.Slot], described: Sequence[int], findings: Findings) -> None:
    """Check the order of files, and of the rows of `meta/episodes`."""
    if wrong := wrong_order(slots):
        what = f"{wrong}; LeRobot takes the rows of all files, in the order of their names, for the frames in order"
        findings.error("order", "data", what, SORTS)
    first = next((place for place, episode in enumerate(described[: len(slots)]) if episode != place), None)
    if first is not None:
        what = f"row {first} is that of episode {described[first]}; LeRobot takes row i for that of episode i"
        findings.error("order", "meta/episodes", what, SORTS)
    wanted = {layout.data_file(slot) for slot in slots}
    last = max(wanted, default="")
    for path in sorted((root / "data").glob("*/*.parquet")):
        name = path.relative_to(root).as_posix()
        if name not in wanted and _rows_in(path):
            is_ordinary = path.match(f"{layout.CHUNKS}.parquet")
            if name < last:
                what = "no described episode is in it, and LeRobot counts its rows: all frames behind it are others"
                findings.error("order", name, what, f"{_MOVE[:-1]}, or run bhd-data repair." if is_ordinary else _MOVE)
            elif not is_ordinary:  # the others are reported as unused
                findings.warning("order", name, "LeRobot reads it, too, where some episodes are selected", _MOVE)
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        if not path.match(f"{layout.CHUNKS}.parquet"):
            what = "LeRobot reads it, too, and takes row i of all these files for that of episode i"
            findings.error("order", path.relative_to(root).as_posix(), what, _MOVE)


def _rows_in(path: Path) -> int:
    try:
        return int(pq.read_metadata(path).num_rows)
    except UNREADABLE:
        return 0  # reported elsewhere: nothing loads while it is there
