"""What is committed on disk: read from ``info.json`` and the episode metadata, and checked against the files.

An episode exists if and only if ``info.json`` counts it. Files of other episodes are leftovers of an interrupted save.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.expected import repeated, wrong_columns, wrong_row, wrong_values
from bhd_lerobot.datasets.format.info import InfoError, kind_of, parse_object, read_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted
from bhd_lerobot.datasets.storage.layout import Slot
from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.datasets.storage.pointers import not_fetched, pulled_in_part
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, UnsupportedDatasetError, counted, quoted

UNREADABLE = (OSError, pa.ArrowException, ValueError)
"""What reading a damaged Parquet file raises; texts in it that are no UTF-8 are a `ValueError`."""

REPAIR_MAY_HELP = ", or see what `bhd-data repair` can recover"

Row = dict[str, Any]
"""One row of ``meta/episodes``, without the statistics."""


@dataclass
class DatasetState:
    """The committed content of a dataset.

    Attributes:
        identity: content of ``meta/bhd.json``; None if another program recorded the dataset.
        tasks: task sentences in the order of their index; may hold more than ``info`` counts after a kill.
        without_stats: committed episodes whose statistics are not stored yet.
        metadata_types: Arrow type of every ``bhd/`` column, empty before the first episode.
        extra_types: Arrow type of columns that neither LeRobot nor this package writes.
    """

    root: Path
    info: dict[str, Any]
    identity: dict[str, Any] | None
    tasks: list[str] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    without_stats: set[int] = field(default_factory=set)
    metadata_types: dict[str, pa.DataType] = field(default_factory=dict)
    extra_types: dict[str, pa.DataType] = field(default_factory=dict)

    @property
    def num_episodes(self) -> int:
        """Committed episodes."""
        return len(self.rows)

    @property
    def num_frames(self) -> int:
        """Committed frames."""
        return self.rows[-1]["dataset_to_index"] if self.rows else 0

    @property
    def video_keys(self) -> list[str]:
        """Camera features."""
        return [key for key, feature in self.info["features"].items() if feature["dtype"] == "video"]

    def files(self, episodes: Iterable[int] | None = None) -> set[str]:
        """Return all files of some committed episodes, or of all, relative to the root."""
        rows = self.rows if episodes is None else [self.rows[episode] for episode in episodes]
        names = {layout.data_file(slot) for slot in ordered_slots(rows, "data")}
        names |= {layout.episodes_file(slot) for slot in ordered_slots(rows, "meta/episodes")}
        for key in self.video_keys:
            names |= {layout.video_file(key, slot) for slot in ordered_slots(rows, f"videos/{key}")}
        return names


def slot_of(row: Row, kind: str) -> Slot:
    """Return the (chunk, file) numbers of a row for ``data``, ``meta/episodes`` or ``videos/<key>``."""
    return row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]


def slot_columns(kind: str, slot: Slot) -> Row:
    """Return the columns that `slot_of` reads."""
    return {f"{kind}/chunk_index": slot[0], f"{kind}/file_index": slot[1]}


def ordered_slots(rows: Iterable[Row], kind: str) -> dict[Slot, list[Row]]:
    """Return the files of one kind in the order of their episodes, each with its rows."""
    slots: dict[Slot, list[Row]] = {}
    for row in rows:
        slots.setdefault(slot_of(row, kind), []).append(row)
    return slots


class DamagedFileError(DatasetCorruptError):
    """A file of a dataset cannot be trusted.

    Attributes:
        wrong: what is wrong with it, without a remedy.
        reason: the same without the path.
        path: the file, or the folder that lacks it; None if there is none.
    """

    def __init__(self, message: str, path: Path | None = None, wrong: str | None = None) -> None:
        super().__init__(message)
        self.path, self.wrong = path, message if wrong is None else wrong
        self.reason = self.wrong.removeprefix(f"{path} is corrupt: ")


def corrupt(path: Path, reason: object) -> DatasetError:
    """Return the error for a file that cannot be trusted, or that was not fetched."""
    if error := not_fetched(path.parent, [path]):
        return error
    remedy = f"Restore this file from a copy (or from the Hub){REPAIR_MAY_HELP}; nothing was changed."
    if path.as_posix().endswith(layout.INFO):
        remedy = repair_with_info(path.parents[1])
    wrong = f"{path} is corrupt: {' '.join(str(reason).split()).rstrip('.')}"
    return DamagedFileError(f"{wrong}. {remedy}", path, wrong)


type Report = Callable[[str, Path, object], None]
"""Takes the name of a check, a file and what is wrong with it; unless it raises, the reader goes on without that."""


def refuse(_: str, path: Path, reason: object) -> None:
    """Raise the error for a file that cannot be trusted; the report of a reader that stops there."""
    raise corrupt(path, reason)


def repair_with_info(root: Path) -> str:
    """Return what to do if `info.json` cannot be used, as text."""
    return (
        "Restore this file from a copy (or from the Hub), or take that of another recording with the same robot and "
        f"cameras, whose counts do not matter: `bhd-data repair {quoted(root)} --info OTHER`. Nothing was changed."
    )


def no_dataset(root: Path) -> DatasetError:
    """Return the error for a place without a ``meta/info.json``."""
    if not root.is_dir():
        found = "is a file" if root.exists() else "is a broken link" if root.is_symlink() else "does not exist"
        return DatasetError(f"{root} is not a LeRobot dataset: it {found}.")
    message = f"{root} is not a LeRobot dataset: it has no meta/info.json."
    if (root / "data").is_dir() or (root / "meta").is_dir():
        return DatasetError(f"{message} {repair_with_info(root)}")
    inside = sorted(path.parents[1].name for path in root.glob(f"*/{layout.INFO}"))
    hint = f" It holds some; name one: {', '.join(inside[:6])}{', …' if len(inside) > 6 else ''}." if inside else ""
    return DatasetError(message + hint)


def load_state(root: Path, *, files: bool = True, videos: bool = True, counted: bool = True) -> DatasetState:
    """Read what is committed and check that every file it needs is there and readable.

    File footers are read, not pages: `bhd_lerobot.datasets.recovery.repair.repair` finds damage inside a file. With
    `files` off, data and videos need not be there; with `counted` off, ``info.json`` may count other frames.
    """
    complete_interrupted(root)
    if not (root / layout.INFO).is_file():
        raise no_dataset(root)
    check_links(root)
    info = load_info(root)
    if info.get("data_path") not in (None, layout.DATA_PATH) or info.get("video_path") not in (None, layout.VIDEO_PATH):
        raise UnsupportedDatasetError(
            f"{root} keeps its files at {info.get('data_path')!r} and {info.get('video_path')!r}; this program reads "
            f"{layout.DATA_PATH!r} and {layout.VIDEO_PATH!r}. Copy it with lerobot-edit-dataset first."
        )
    identity = read_identity(root)
    state = DatasetState(root, info, identity)
    if info["total_episodes"]:
        state.tasks = read_tasks(root / layout.TASKS)
        if len(state.tasks) < info["total_tasks"]:
            raise corrupt(root / layout.TASKS, f"it has {len(state.tasks)} of {info['total_tasks']} tasks")
        read_rows(state)
        if files:
            needed = [name for name in state.files() if videos or not name.startswith("videos/")]
            if (root / layout.SUBSET).is_file() and not all((root / name).is_file() for name in needed):
                raise pulled_in_part(root)
            _check_files(state, videos, counted)
    return state


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object."""
    try:
        return parse_object(path.read_bytes())
    except (OSError, InfoError) as error:
        raise corrupt(path, error) from error


def read_identity(root: Path) -> dict[str, Any] | None:
    """Return the content of ``meta/bhd.json``; None if another program recorded the dataset."""
    path = root / layout.IDENTITY
    if not path.exists():
        return None
    identity = {"recording": {}, "video": {}, **read_json(path)}
    for key in ("recording", "video"):
        if not isinstance(identity[key], dict):
            raise corrupt(path, f"{key!r} is {kind_of(identity[key])} and no JSON object")
    return identity


def load_info(root: Path) -> dict[str, Any]:
    """Return the content of ``meta/info.json``, checked and with defaults; see `info.checked_info`."""
    path = root / layout.INFO
    try:
        return read_info(path, root)
    except (OSError, InfoError) as error:
        raise corrupt(path, error) from error


def numbered_tasks(path: Path) -> dict[int, str]:
    """Return the instructions by their numbers, in the order of the file."""
    try:
        table = pq.ParquetFile(path, page_checksum_verification=True).read(use_threads=False)
        # LeRobot keeps the sentence in the index of a pandas table; the column name differs between its versions.
        name = next(n for n in table.column_names if n != "task_index")
        tasks = dict(zip(table["task_index"].to_pylist(), table[name].to_pylist(), strict=True))
    except (*UNREADABLE, KeyError, StopIteration, TypeError) as error:
        raise corrupt(path, error) from error
    if table.num_rows != len(tasks) or not all(isinstance(number, int) and number >= 0 for number in tasks):
        raise corrupt(path, "not every instruction has a number of its own, from 0 on")
    if not all(isinstance(task, str) for task in tasks.values()):
        raise corrupt(path, "not all of its instructions are texts")
    return tasks


def read_tasks(path: Path) -> list[str]:
    """Return the instructions in the order of their numbers."""
    tasks = numbered_tasks(path)
    if tasks.keys() != set(range(len(tasks))):
        raise corrupt(path, f"its numbers are not 0 to {len(tasks) - 1}, each once")
    return [tasks[index] for index in range(len(tasks))]


def read_rows(state: DatasetState, report: Report = refuse, *, is_full: bool = False) -> list[int]:
    """Read the rows of the committed episodes into `state.rows`; with `is_full`, every page of their files.

    Returns:
        The number of the episode of each row, in the order of the files.
    """
    total = state.info["total_episodes"]
    by_index: dict[int, Row] = {}
    refused: set[Any] = set()
    described: list[int] = []
    for path in sorted((state.root / "meta/episodes").glob("chunk-*/file-*.parquet")):
        try:
            file = pq.ParquetFile(path, page_checksum_verification=is_full)
            names = file.schema_arrow.names
            light = [name for name in names if not name.startswith("stats/")]
            table = file.read(columns=None if is_full else light, use_threads=is_full)
            rows = table.select([i for i, name in enumerate(table.column_names) if name in light]).to_pylist()
            slot = layout.slot_in(path)
        except UNREADABLE as error:
            report("files", path, error)
            continue
        if wrong := repeated(file.schema_arrow):
            report("schema", path, wrong)
            continue
        is_reported = False
        for row in rows:
            index = row.get("episode_index")
            described.append(index)
            if index is None and is_full:
                report("schema", path, "the episode_index of a row is null")
            if index is None or (isinstance(index, int) and index >= total):
                continue  # a save that was interrupted before it counted
            if wrong := wrong_row(row, state.video_keys):
                if not is_reported:
                    report("schema", path, f"episode {index!r} {wrong}")
                is_reported = True
                refused.add(index)
            elif index in by_index:
                report("counts", path, f"episode {index} is described twice")
            else:
                by_index[index] = row | slot_columns("meta/episodes", slot)  # the file knows better than its row
                if "stats/index/mean" not in names:
                    state.without_stats.add(index)
        own, extra = column_types(file.schema_arrow)
        state.metadata_types = {**own, **state.metadata_types}
        state.extra_types = {**extra, **state.extra_types}
    if missing := [index for index in range(total) if index not in by_index and index not in refused]:
        many = f"{counted(len(missing), 'episode')} {'is' if len(missing) == 1 else 'are'} not described"
        what = f"{many}, {missing[0]} first; meta/info.json counts {total}"
        report("counts", state.root / "meta/episodes", what)
    state.rows = [by_index[index] for index in sorted(by_index)]
    return described


def check_places(state: DatasetState, report: Report = refuse) -> int:
    """Check that the frames of each episode follow those of the one before; return how many frames there are."""
    start, following, wrong = 0, 0, []
    for row in state.rows:
        first, last = row["dataset_from_index"], row["dataset_to_index"]
        if row["episode_index"] != following:
            start = first  # nothing is known of the one before
        following = row["episode_index"] + 1
        if first != start or last != first + row["length"]:
            wrong.append((row, f"has {row['length']} frames, from {first} to {last}; it should begin at {start}"))
        start = last
    for row, what in wrong[:3]:
        path = state.root / layout.episodes_file(slot_of(row, "meta/episodes"))
        report("counts", path, f"episode {row['episode_index']} {what}")
    return sum(row["length"] for row in state.rows)


def read_frames(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Return a data file, or some of its columns."""
    try:
        table = pq.ParquetFile(path, page_checksum_verification=True).read(columns, use_threads=False)
    except UNREADABLE as error:
        raise corrupt(path, error) from error
    if wrong := wrong_values(table):
        raise corrupt(path, wrong)
    return table


def column_types(schema: pa.Schema) -> tuple[dict[str, pa.DataType], dict[str, pa.DataType]]:
    """Return the types of the columns of ``meta/episodes`` that are ours, without prefix, and of those of others."""
    own = {name.removeprefix("bhd/"): schema.field(name).type for name in schema.names if name.startswith("bhd/")}
    known = ("bhd/", "stats/", "data/", "videos/", "meta/episodes/")
    extra = {
        name: schema.field(name).type for name in schema.names if not name.startswith(known) and name not in _STRUCTURE
    }
    return own, extra


_STRUCTURE = ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index")


def _check_files(state: DatasetState, videos: bool, counted: bool) -> None:
    frames = check_places(state)
    if counted and frames != state.info["total_frames"]:
        raise DatasetCorruptError(
            f"{state.root / layout.INFO} counts {state.info['total_frames']} frames; its episodes have {frames}. "
            f"`bhd-data check {quoted(state.root)} --fix` corrects the count. Nothing was changed."
        )
    for slot, rows in ordered_slots(state.rows, "data").items():
        path = state.root / layout.data_file(slot)
        wanted = sum(row["length"] for row in rows)
        try:
            footer = pq.read_metadata(path)
            found, schema = footer.num_rows, footer.schema.to_arrow_schema()
        except UNREADABLE as error:
            raise corrupt(path, error) from error
        if found != wanted:
            raise corrupt(path, f"it has {found} frames; its episodes have {wanted}")
        if wrong := wrong_columns(schema, state.info["features"]):
            raise corrupt(path, wrong)
    for key in state.video_keys if videos else ():
        for slot in ordered_slots(state.rows, f"videos/{key}"):
            path = state.root / layout.video_file(key, slot)
            if not path.is_file() or path.stat().st_size == 0:
                raise corrupt(path, "it is missing or empty")
