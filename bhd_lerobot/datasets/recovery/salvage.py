"""Recover every whole episode of a dataset that cannot be read: a recorder was killed, or files are damaged.

LeRobot keeps one Parquet file open for a whole recording, and no reader opens a file without its footer; it writes
``meta/episodes`` once in ten episodes, and ``info.json`` and a video with each. After a kill nothing loads, though
nearly everything is on disk. Here the frames are read without the footer, the frames of videos are counted, and an
episode is recovered if all of its frames are there in all of its columns and videos. The other files of ``meta`` are
computed from these episodes.
"""

import contextlib
import datetime
import os
from collections.abc import Iterable, Iterator, Sequence
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
from bhd_lerobot.datasets.recovery.outcomes import RECOVERED, logged, restore_outcomes
from bhd_lerobot.datasets.recovery.rows import info_of, rows_of, tasks_of, write_data
from bhd_lerobot.datasets.recovery.statistics import stats_of
from bhd_lerobot.datasets.recovery.videos import FoundEpisode, Videos
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import WORK, Workspace, link_others
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.datasets.validate.findings import Finding, Findings, Severity
from bhd_lerobot.errors import (
    DatasetCorruptError,
    DatasetError,
    DatasetLockedError,
    UnsupportedDatasetError,
    brief,
    counted,
)


@dataclass(frozen=True)
class RepairReport:
    """The result of a repair. It is false if there was nothing to do.

    Attributes:
        root: the dataset.
        episodes: episodes it holds now.
        frames: frames it holds now.
        completed: interrupted steps that were completed, and other repairs.
        dropped: files of unfinished episodes that were removed, relative to the root.
        findings: of a corrupted dataset: errors are losses, notes are uncertain.
        aside: the folder of its damaged files; None if none were damaged.
    """

    root: Path
    episodes: int
    frames: int
    completed: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    aside: Path | None = None

    @property
    def lost(self) -> tuple[str, ...]:
        """What could not be recovered, and why, a line each."""
        return _losses(self.findings)

    def __bool__(self) -> bool:
        return bool(self.completed or self.dropped)

    def __str__(self) -> str:
        empty = "" if self.episodes else ": it is empty"
        lines = [f"{self.root}: {counted(self.episodes, 'episode')}, {counted(self.frames, 'frame')}{empty}"]
        lines += [f"  completed: {item}" for item in self.completed]
        lines += [f"  dropped: {item}" for item in self.dropped]
        lines += [f"  lost: {item}" for item in self.lost or ("nothing",) * (self.aside is not None)]
        lines += [f"  note: {finding}" for finding in self.findings if finding.severity is Severity.NOTE]
        lines += [f"  the damaged files are in {self.aside}"] if self.aside is not None else []
        return "\n".join(lines if self else [*lines, "  nothing to do"])


def _losses(findings: Iterable[Finding]) -> tuple[str, ...]:
    return tuple(str(finding) for finding in findings if finding.severity is Severity.ERROR)


def salvage(root: Path, disk: Disk, lock: RootLock, wrong: str, *, is_ours: bool = False) -> RepairReport:
    """Recover every whole episode.

    Damaged files go to a folder beside the dataset first, so nothing that was there is lost.
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
    findings, stored = Findings(), EpisodeRows(root)
    found, surplus, is_torn = _frames(root, info, findings)
    videos = Videos(root, info, stored.rows)
    recovered = videos.assign(found, findings, is_torn=is_torn)
    counted = info.get("total_episodes")
    # If all counted episodes are there, and no others, these bytes are of a footer or of frames that were never saved.
    is_all = counted == len(recovered) > 0 and [episode.number for episode in recovered] == list(range(len(recovered)))
    for name, what in surplus.items():
        (findings.note if is_all else findings.error)("files", name, what)
    if not recovered:
        raise _nothing_left(root, info, wrong, findings)
    for number in sorted(stored.rows.keys() - {episode.number for episode in found}):
        findings.error("files", f"episode {number}", "its frames are gone")
    if isinstance(counted, int) and counted > len(recovered) and not _losses(findings):
        # It may be a copy of another recording's, so this is no loss.
        what = (
            f"it counted {counted} episodes. No other file has a trace of more than {len(recovered)}; if it is a copy "
            "of another recording's, its counts mean nothing"
        )
        findings.note("counts", layout.INFO, what)
    with write_errors("recover the dataset", root, "The damaged files are as they were."):
        aside = _keep_aside(root, disk)
        with Workspace(root, disk, lock) as space:
            new = space.folder
            tasks, renumbered = tasks_of(root, recovered, stored, findings)
            rows = rows_of(recovered, tasks, renumbered)
            described = info_of(info, recovered, len(tasks))
            write_data(recovered, rows, described, new, disk)
            videos.write(recovered, rows, described, new, disk)
            stored.complete(recovered, rows)
            restore_outcomes(root, recovered, rows, stored, findings, is_ours=is_ours)
            stats = stats_of(
                (episode.table for episode in recovered), described["features"], new, rows, stored.stats_of(recovered)
            )
            link_others(root / "meta", new / "meta", disk, *WRITTEN, take=disk.copy)
            sink = pa.BufferOutputStream()
            pq.write_table(tasks_table(tasks), sink)
            disk.write(new / layout.TASKS, memoryview(sink.getvalue()))
            write_meta(new, described, rows, stored.metadata_types, stats, disk=disk, extra=stored.extra_types)
            disk.write(new / layout.INFO, to_json(described))
            if identity is not None:
                # The recorder cannot continue it any more.
                recording = {**(identity.get("recording") or {}), "edited": {"edit": RECOVERED}}
                disk.write(new / layout.IDENTITY, to_json({**identity, "recording": recording}))
            if identity is not None or (root / EDITS).is_file():
                time = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
                disk.write(new / EDITS, logged(root, recovered, time))
            space.publish(f"what is whole of {root} had been recovered")
        # Folders of videos that were being made, which are among the damaged files, too.
        for name in (layout.STAGING, "images", *(path.name for path in root.glob("tmp*") if path.is_dir())):
            disk.try_remove_tree(root / name)
    frames = sum(episode.table.num_rows for episode in recovered)
    return RepairReport(root, len(recovered), frames, findings=tuple(findings), aside=aside)


def _nothing_left(root: Path, info: dict[str, Any], wrong: str, findings: Findings) -> DatasetCorruptError:
    if cameras := lost_cameras(root, info):
        what = f"it describes {brief(cameras)}, of which there is no video and no image. If it is another recording's: "
        findings.error("video", layout.INFO, what + repair_with_info(root))
    reasons = "".join(f"\n  {finding}" for finding in findings)
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
        f"{root / layout.INFO} is corrupt: {reason}. It describes the columns, without which nothing can be read. "
        f"{repair_with_info(root)}"
    )


def _frames(root: Path, info: dict[str, Any], findings: Findings) -> tuple[list[FoundEpisode], dict[str, str], bool]:
    """Read the data files.

    Returns:
        The episodes whose frames are whole, in order; for each file with bytes that belong to no whole row group a text
        on these bytes, with which something may be lost; and whether frames are missing behind the episodes.
    """
    found: list[FoundEpisode] = []
    surplus: dict[str, str] = {}
    is_torn = False
    schema = schema_of(root, info)
    shapes = shapes_of(info)
    for path in sorted((root / "data").glob("chunk-*/file-*.parquet")):
        name = path.relative_to(root).as_posix()
        try:
            rescued = rescue(path, schema, shapes)
        except OSError as error:
            findings.error("files", name, error.strerror or str(error))
            is_torn = True
            continue
        except ValueError as error:
            raise UnsupportedDatasetError(f"{path} has no footer and cannot be read without: {error}.") from error
        is_torn |= bool(rescued.lost_bytes) or not rescued.groups
        if not rescued.groups:
            findings.error("files", name, rescued.problem)
            continue
        if rescued.lost_bytes:
            where = "at its end, in which no episode is whole" if rescued.is_cut else f"are damaged: {rescued.problem}"
            surplus[name] = f"{rescued.lost_bytes} bytes {where}"
        table = pa.concat_tables(rescued.groups).combine_chunks()
        missing = [column for column in schema.names if table.column_names.count(column) != 1]
        wrong = f"it has no column {', '.join(missing)}, or more than one" if missing else ""
        if wrong := wrong or wrong_columns(table.schema, info["features"]) or wrong_values(table):
            findings.error("schema", name, wrong)
            continue
        table = table.select(schema.names)
        if not table.schema.metadata:
            table = table.replace_schema_metadata(schema.metadata)
        for number, part in _episodes(_sorted(table)):
            frames = part["frame_index"].to_numpy()
            if np.array_equal(frames, np.arange(len(frames))):
                found.append(FoundEpisode(number, part))
            else:
                findings.error("counts", name, f"episode {number}, whose frames are not numbered from 0 on")
    return sorted(found, key=lambda episode: episode.number), surplus, is_torn


def shapes_of(info: dict[str, Any]) -> dict[str, Sequence[int]]:
    """Return the shapes of columns of nested lists, by name."""
    return {
        key: feature["shape"]
        for key, feature in info["features"].items()
        if len(feature["shape"]) > 1 and feature["dtype"] not in ("image", "video")
    }


def schema_of(root: Path, info: dict[str, Any]) -> pa.Schema:
    """Return the columns of the data files, as `info.json` describes them."""
    from bhd_lerobot.stock import get_hf_features_from_features

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


def _sorted(table: pa.Table) -> pa.Table:
    """Return frames in the order of their numbers, if all of these agree on one and no frame is there twice."""
    order = np.lexsort((table["frame_index"].to_numpy(), table["episode_index"].to_numpy()))
    index = table["index"].to_numpy()[order]
    is_permuted = (np.diff(order) < 0).any() and (np.diff(index) > 0).all()
    return table.take(order) if is_permuted else table


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
    """Check that no other process has a file below `root` open: LeRobot takes no lock."""
    own, place = str(os.getpid()), root.resolve()
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == own:
            continue
        with contextlib.suppress(OSError):  # ended meanwhile, or of another user
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
    """Check that every byte can be read below `root`.

    A file that cannot be read at the moment may be whole: without it, its episodes would be lost for nothing.
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
