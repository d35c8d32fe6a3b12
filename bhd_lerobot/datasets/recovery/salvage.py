"""Bring back every whole episode of a dataset that cannot be read: a recorder was killed, or files are damaged.

LeRobot keeps one Parquet file open for a whole recording, and a file without its footer is read by nobody; it writes
``meta/episodes`` ten episodes at a time, and ``info.json`` and a video at each. So after a kill nothing loads, though
nearly everything is on disk. Here the frames are read without the footer, videos are counted, and an episode is kept if
all of its frames are there in all of its columns and videos. Everything else of ``meta`` is made anew from that.
"""

import contextlib
import datetime
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.assemble import EDITS, WRITTEN
from bhd_lerobot.datasets.format.expected import wrong_columns, wrong_values
from bhd_lerobot.datasets.format.meta_files import tasks_table, write_meta
from bhd_lerobot.datasets.format.parquet_rescue import rescue
from bhd_lerobot.datasets.format.state import corrupt, read_identity, repair_with_info
from bhd_lerobot.datasets.recovery.columns import lost_cameras, misfit, read_info
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.outcomes import RECOVERED, logged, recall
from bhd_lerobot.datasets.recovery.rows import info_of, rows_of, tasks_of, write_data
from bhd_lerobot.datasets.recovery.statistics import stats_of
from bhd_lerobot.datasets.recovery.videos import Found, Videos
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import WORK, Workspace, link_others
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.datasets.validate.findings import few
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, DatasetLockedError, UnsupportedDatasetError


@dataclass(frozen=True)
class Salvage:
    """What became of a corrupted dataset.

    Attributes:
        episodes: whole episodes that were recovered.
        frames: their frames.
        lost: what was lost, and why, a line each.
        hints: what may be so, a line each.
        aside: where the damaged files lie now.
    """

    episodes: int
    frames: int
    lost: tuple[str, ...]
    hints: tuple[str, ...]
    aside: Path


def salvage(root: Path, disk: Disk, lock: RootLock, wrong: str, *, is_ours: bool = False) -> Salvage:
    """Recover every whole episode.

    Damaged files go to a folder beside the dataset first, so nothing that was there is lost.

    Args:
        root: the corrupted dataset.
        disk: how to write.
        lock: of the dataset.
        wrong: what was found to be wrong, for the error if nothing is left.
        is_ours: whether our recorder alone wrote it.

    Raises:
        DatasetCorruptError: no whole episode is left, or ``info.json`` is gone, which says what the columns are;
            nothing was changed.
        DatasetLockedError: a process has files of the dataset open, so perhaps records it.
        DatasetError: the disk does not give out a file, which may be whole.
        DatasetWriteError: the disk refuses; the corrupted dataset is as it was.
    """
    check_unused(root)
    check_readable(root)
    identity = read_identity(root)
    info = _info_of(root)
    if other := misfit(root, info):
        raise DatasetCorruptError(
            f"{root / layout.INFO} describes other data than those of {root}: {other}. Perhaps it is another "
            f"recording's. {repair_with_info(root)}"
        )
    lost: list[str] = []
    hints: list[str] = []
    told = EpisodeRows(root)
    torn: list[str] = []
    found, is_torn = _frames(root, info, lost, torn)
    videos = Videos(root, info, told.rows)
    kept = videos.assign(found, lost, is_torn=is_torn)
    counted = info.get("total_episodes")
    # Where all that was counted is there, and no more, the bytes are of a footer or of what was never saved.
    is_all = counted == len(kept) > 0 and [one.number for one in kept] == list(range(len(kept)))
    (hints if is_all else lost).extend(torn)
    if not kept:
        raise _nothing_left(root, info, wrong, lost)
    numbers = {one.number for one in found}
    lost += [f"episode {number}: its frames are gone" for number in sorted(told.rows.keys() - numbers)]
    if isinstance(counted, int) and counted > len(kept) and not lost:
        # It may be a copy of another recording's, so this is no loss.
        hints.append(
            f"{layout.INFO} counted {counted} episodes. No other file has a trace of more than {len(kept)}; if it is a "
            "copy of another recording's, its counts mean nothing"
        )
    with write_errors("recover the dataset", root, "The damaged files are as they were."):
        aside = _keep_aside(root, disk)
        with Workspace(root, disk, lock) as space:
            new = space.folder
            tasks, renumbered = tasks_of(root, kept, told, lost)
            rows = rows_of(kept, tasks, renumbered)
            described = info_of(info, kept, len(tasks))
            write_data(kept, rows, described, new, disk)
            videos.write(kept, rows, described, new, disk)
            told.complete(kept, rows)
            forgotten, known = recall(root, kept, rows, told, is_ours=is_ours)
            lost += forgotten
            hints += known
            stats = stats_of((one.table for one in kept), described["features"], new, rows, told.stats_of(kept))
            link_others(root / "meta", new / "meta", disk, *WRITTEN, take=disk.copy)
            sink = pa.BufferOutputStream()
            pq.write_table(tasks_table(tasks), sink)
            disk.write(new / layout.TASKS, memoryview(sink.getvalue()))
            write_meta(new, described, rows, told.metadata_types, stats, disk=disk, extra=told.extra_types)
            disk.write(new / layout.INFO, to_json(described))
            if identity is not None:
                disk.write(new / layout.IDENTITY, to_json(_disowned(identity)))
            if identity is not None or (root / EDITS).is_file():
                time = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
                disk.write(new / EDITS, logged(root, kept, time))
            space.publish(f"what is whole of {root} had been recovered")
        _remove_unfinished(root, disk)
    return Salvage(len(kept), sum(one.table.num_rows for one in kept), tuple(lost), tuple(hints), aside)


def _remove_unfinished(root: Path, disk: Disk) -> None:
    """Remove folders of videos that were being made; they are kept aside."""
    for name in (layout.STAGING, "images", *(path.name for path in root.glob("tmp*") if path.is_dir())):
        disk.try_remove_tree(root / name)


def _nothing_left(root: Path, info: dict[str, Any], wrong: str, lost: list[str]) -> DatasetCorruptError:
    if cameras := lost_cameras(root, info):
        lost.append(
            f"{layout.INFO} describes {few(cameras)}, of which there is no video and no image. If it is another "
            f"recording's: {repair_with_info(root)}"
        )
    reasons = "".join(f"\n  {line}" for line in lost)
    return DatasetCorruptError(
        f"{wrong}. No whole episode of {root} can be recovered; nothing was changed. Restore this file from a copy (or "
        f"from the Hub).{reasons}"
    )


def _info_of(root: Path) -> dict[str, Any]:
    """Return ``info.json``. LeRobot empties it before it writes it, so a kill may leave nothing."""
    try:
        return read_info(root / layout.INFO)
    except DatasetCorruptError as error:
        reason = str(error.__cause__ or error)
    raise DatasetCorruptError(
        f"{root / layout.INFO} is corrupt: {reason}. It says what the columns are, without which nothing can be read. "
        f"{repair_with_info(root)}"
    )


def _disowned(identity: dict[str, Any]) -> dict[str, Any]:
    """Keep what is told about the recording, but not as one that its recorder can go on with."""
    return {**identity, "recording": {**(identity.get("recording") or {}), "edited": {"edit": RECOVERED}}}


def _frames(root: Path, info: dict[str, Any], lost: list[str], torn: list[str]) -> tuple[list[Found], bool]:
    """Return the episodes whose frames are whole, in order, and whether some frames are missing behind them.

    Bytes that belong to no whole row group are told in `torn`: whether something is lost with them is not known here.
    """
    found: list[Found] = []
    is_torn = False
    schema = schema_of(root, info)
    shapes = shapes_of(info)
    for path in sorted((root / "data").glob("chunk-*/file-*.parquet")):
        name = path.relative_to(root).as_posix()
        try:
            rescued = rescue(path, schema, shapes)
        except OSError as error:
            lost.append(f"{name}: {error.strerror or error}")
            is_torn = True
            continue
        except ValueError as error:
            raise UnsupportedDatasetError(f"{path} has no footer and cannot be read without: {error}.") from error
        if rescued.groups and rescued.lost_bytes:
            where = "at its end, in which no episode is whole" if rescued.is_cut else f"are damaged: {rescued.problem}"
            torn.append(f"{name}: {rescued.lost_bytes} bytes {where}")
        elif not rescued.groups:
            lost.append(f"{name}: {rescued.problem}")
        is_torn |= bool(rescued.lost_bytes) or not rescued.groups
        if not rescued.groups:
            continue
        table = pa.concat_tables(rescued.groups).combine_chunks()
        if missing := [column for column in schema.names if table.column_names.count(column) != 1]:
            lost.append(f"{name}: it has no column {', '.join(missing)}, or more than one")
            continue
        if wrong := wrong_columns(table.schema, info["features"]) or wrong_values(table):
            lost.append(f"{name}: {wrong}")
            continue
        table = table.select(schema.names)
        if not table.schema.metadata:
            table = table.replace_schema_metadata(schema.metadata)
        for number, part in _episodes(table):
            frames = part["frame_index"].to_numpy()
            if np.array_equal(frames, np.arange(len(frames))):
                found.append(Found(number, part))
            else:
                lost.append(f"{name}: episode {number}, whose frames are not numbered from 0 on")
    return found, is_torn


def shapes_of(info: dict[str, Any]) -> dict[str, Sequence[int]]:
    """Return the shapes of columns of nested lists, by name."""
    return {
        key: feature["shape"]
        for key, feature in info["features"].items()
        if len(feature["shape"]) > 1 and feature["dtype"] not in ("image", "video")
    }


def schema_of(root: Path, info: dict[str, Any]) -> pa.Schema:
    """Return the columns of the data files, as `info.json` describes them.

    Raises:
        DatasetCorruptError: it does not.
    """
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    try:
        features = {key: {**feature, "shape": tuple(feature["shape"])} for key, feature in info["features"].items()}
        return get_hf_features_from_features(features).arrow_schema
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise corrupt(root / layout.INFO, f"its features cannot be understood ({error})") from error


def _episodes(table: pa.Table) -> Iterator[tuple[int, pa.Table]]:
    numbers = table["episode_index"].to_numpy()
    if not len(numbers):
        return
    begins = np.flatnonzero((np.diff(numbers, prepend=-1) != 0) | (table["frame_index"].to_numpy() == 0))
    for start, end in zip(begins, [*begins[1:], len(numbers)], strict=True):
        yield int(numbers[start]), table.slice(start, end - start)


def _keep_aside(root: Path, disk: Disk) -> Path:
    """Link every file into a new folder beside the dataset, but for what an attempt before left half built."""
    aside = layout.aside_of(root)
    for path in sorted(root.rglob("*")):
        if path.is_file() and not path.is_relative_to(root / WORK):
            disk.make_folder((aside / path.relative_to(root)).parent)
            disk.link(path, aside / path.relative_to(root))
    return aside


_BLOCK = 1 << 20


def check_unused(root: Path) -> None:
    """Check that no other process has a file below `root` open: LeRobot takes no lock.

    Raises:
        DatasetLockedError: one has.
    """
    own, place = str(os.getpid()), root.resolve()
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == own:
            continue
        with contextlib.suppress(OSError):  # ended meanwhile, or somebody else's
            for handle in (process / "fd").iterdir():
                with contextlib.suppress(OSError):
                    target = Path(os.readlink(handle))
                    if target != place and place in target.parents:
                        raise DatasetLockedError(
                            f"Process {process.name} has {target} open, so {root} may be in the middle of a "
                            "recording. Wait until it ends; without its last files a running recording looks like a "
                            "corrupted dataset."
                        )


def check_readable(root: Path) -> None:
    """Check that the disk gives out every byte below `root`.

    A file that may not be read, or not at this moment, is not damaged: its episodes would be given up for nothing.

    Raises:
        DatasetError: it refuses, or a link leads out of the dataset.
    """
    check_links(root)

    def refuse(error: OSError) -> NoReturn:
        raise DatasetError(
            f"{error.filename or root} cannot be read: {error.strerror or error}. Such a file is not recovered, for "
            "it may be whole: check its permissions and the disk, and repeat. Nothing was changed."
        ) from error

    for folder, _, names in os.walk(root, onerror=refuse):
        for name in sorted(names):
            path = Path(folder, name)
            if path.is_symlink() and not path.exists():
                continue  # it leads nowhere: the file is missing
            try:
                with open(path, "rb", buffering=0) as file:
                    while file.read(_BLOCK):
                        pass
            except OSError as error:
                refuse(OSError(error.errno, error.strerror, str(path)))
