"""Complete or drop what an interrupted recording left behind, and recover what is whole where files are damaged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.compact import compact
from bhd_lerobot.datasets.format import video
from bhd_lerobot.datasets.format.columns import NUMBERS, numbers_of, wrong_number
from bhd_lerobot.datasets.format.parquet_rescue import is_cut_off, is_parquet
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import (
    REPAIR_MAY_HELP,
    DamagedFileError,
    DatasetState,
    corrupt,
    load_state,
    no_dataset,
    ordered_slots,
    read_frames,
    read_json,
    slot_of,
)
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.fix import is_fixable, rebuild
from bhd_lerobot.datasets.recovery.info import replace_info, restore_info
from bhd_lerobot.datasets.recovery.salvage import RepairReport, salvage
from bhd_lerobot.datasets.recovery.videos import whole_frames
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import clean, real, remove_abandoned, roll_forward
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, write_errors
from bhd_lerobot.datasets.storage.pointers import check_fetched
from bhd_lerobot.datasets.validate.files import read_files
from bhd_lerobot.datasets.validate.findings import Findings
from bhd_lerobot.datasets.validate.order import check_numbers
from bhd_lerobot.errors import DatasetCorruptError


def repair(root: Path | str, info: Path | str | None = None) -> RepairReport:
    """Repair a dataset, check every file to the last page, and leave it compact and with statistics.

    Args:
        root: the dataset.
        info: another recording with the same robot and cameras, or its `meta/info.json`: if the dataset's own is lost.

    Raises:
        DatasetLockedError: it is being recorded at this moment.
        DatasetCorruptError: files are damaged and no whole episode can be recovered; nothing was changed then.
        DatasetError: there is no dataset at `root`, or one of its files cannot be read, or was not fetched.
        ConfigError: `info` is not needed, cannot be read or describes other data.
        DatasetWriteError: the disk refuses the repaired files.
    """
    root = Path(root)
    if not root.is_dir():
        raise no_dataset(root)
    check_fetched(root)
    lock = RootLock(root)
    try:
        disk = Disk()
        if info is not None:
            return _repair_with(root, Path(info), disk, lock)
        is_ours = (root / layout.IDENTITY).exists()
        if (root / layout.INFO).is_file() and (not is_ours or continued_elsewhere(root)):
            return _repair_foreign(root, disk, lock)
        return _repair_own(root, disk, lock)
    except DatasetCorruptError as error:
        # The advice to run `repair` is of no use any more.
        raise DatasetCorruptError(str(error).replace(REPAIR_MAY_HELP, "")) from error
    finally:
        lock.release()


def _repair_own(root: Path, disk: Disk, lock: RootLock) -> RepairReport:
    """Finish what our recorder or an edit began; where saved files are damaged, recover the episodes that are whole."""
    report = RepairReport(root, 0, 0)
    try:
        with write_errors("repair the dataset", root, "Its saved episodes are intact."):
            state, report = restore_committed(root, disk)
            _check_deeply(state)
            if state.identity is not None and compact(state, Schema(state.info["features"]), disk, lock):
                what = f"compaction and statistics of {len(state.without_stats)} episodes"
                disk.remove_tree(root / layout.STAGING)
                report = replace(report, completed=(*report.completed, what))
            report = _in_order(root, disk, lock, report)
    except DamagedFileError as error:
        # These two nothing else can replace: what the columns are, and who recorded it how.
        if error.path in (root / layout.INFO, root / layout.IDENTITY):
            raise
        rescued = _salvaged(root, disk, lock, error, report.completed, is_ours=True)
        return replace(rescued, dropped=report.dropped)
    return report


def _salvaged(
    root: Path,
    disk: Disk,
    lock: RootLock,
    error: DatasetCorruptError,
    completed: tuple[str, ...],
    *,
    is_ours: bool = False,
) -> RepairReport:
    wrong = error.wrong if isinstance(error, DamagedFileError) else str(error).split(". ", 1)[0]
    rescued = salvage(root, disk, lock, wrong, is_ours=is_ours)
    what = f"{rescued.episodes} whole episodes were recovered, with new statistics. What was wrong: {wrong}"
    return replace(rescued, completed=(*completed, what))


def _repair_with(root: Path, donor: Path, disk: Disk, lock: RootLock) -> RepairReport:
    """Repair a dataset whose `info.json` is lost.

    Frames that belong to no episode are recovered then, not dropped: no file records any more which were saved.
    """
    consequence = "Its files are as they were."
    with write_errors("repair the dataset", root, consequence):
        roll_forward(root)
        clean(root)
        adopted, saved = replace_info(root, donor, disk)
    try:
        report = _repair_foreign(root, disk, lock, adopted)
    except BaseException:
        with write_errors("repair the dataset", root, consequence):
            restore_info(root, saved, disk)
        raise
    return report if saved is None or report.aside is not None else replace(report, aside=saved.parents[1])


def _repair_foreign(root: Path, disk: Disk, lock: RootLock, *completed: str) -> RepairReport:
    """Repair what another program wrote: nothing if all of it can be read, and else everything that is whole."""
    with write_errors("repair the dataset", root, "Its files are as they were."):
        remove_abandoned(real(root))
        if roll_forward(root):
            completed += ("a change that was interrupted while its files were moved in",)
        disk.remove_tree(root / layout.STAGING)  # of an attempt that was interrupted
    try:
        state = load_state(root)
        if unfinished := unfinished_files(root):
            raise corrupt(unfinished[0], "its writer was killed")
        extra = sorted(name for name in layout.recorded_files(root) - state.files() if name.startswith("data/"))
        if extra := [name for name in extra if is_parquet(root / name)]:
            raise corrupt(root / extra[0], "no episode of meta/episodes is in it")
        _check_readable(state)
    except DatasetCorruptError as error:
        return _salvaged(root, disk, lock, error, completed)
    with write_errors("repair the dataset", root, "Its files are as they were."):
        if state.rows and not _has_stats(root):
            completed = (*completed, *rebuild(state, disk, lock, stats=True))
        return _in_order(root, disk, lock, RepairReport(root, state.num_episodes, state.num_frames, completed))


def _in_order(root: Path, disk: Disk, lock: RootLock, report: RepairReport) -> RepairReport:
    """Put files, rows, frames and instructions in the order of their numbers, if they are in another one."""
    findings = Findings()
    files = read_files(root, findings)
    for slot, rows in ordered_slots(files.rows, "data").items():
        path = root / layout.data_file(slot)
        table = read_frames(path, [*NUMBERS, "task_index"])
        check_numbers(path, table, rows, files.tasks, findings)
    if not any(is_fixable(finding) and finding.check != "stats" for finding in findings):
        return report
    return replace(report, completed=(*report.completed, *rebuild(load_state(root), disk, lock, order=True)))


def unfinished_files(root: Path) -> list[Path]:
    """Return the data and episode files without a footer. Ours never are: they get their names when they are whole."""
    paths = [root / name for name in sorted(layout.recorded_files(root))]
    return [path for path in paths if path.suffix == ".parquet" and is_cut_off(path)]


def continued_elsewhere(root: Path) -> list[Path]:
    """Return what another program left unfinished when it went on with a dataset of ours.

    A file that our own rows need and that is cut off is damage of another kind. LeRobot always leaves a data file.
    """
    unfinished = unfinished_files(root)
    rows = EpisodeRows(root).rows.values() if any(path.is_relative_to(root / "data") for path in unfinished) else ()
    needed = {root / layout.data_file(slot_of(row, "data")) for row in rows}
    return [] if not rows or needed & set(unfinished) else unfinished


def _has_stats(root: Path) -> bool:
    try:
        return bool(read_json(root / layout.STATS))
    except DatasetCorruptError:
        return False


def _check_readable(state: DatasetState) -> None:
    """Check that all frames of all episodes can be read, where their rows say that they are."""
    _check_data(state)
    for key in state.video_keys:
        kind = f"videos/{key}"
        for slot, rows in ordered_slots(state.rows, kind).items():
            path = state.root / layout.video_file(key, slot)
            needed = max(round(row[f"{kind}/from_timestamp"] * state.info["fps"]) + row["length"] for row in rows)
            frames, problem = whole_frames(path)
            if frames < needed:
                raise corrupt(path, f"it has {frames} of {needed} frames; {problem or 'it ends'}")


def restore_committed(root: Path, disk: Disk, *, keep_staging: bool = False) -> tuple[DatasetState, RepairReport]:
    """Bring the disk to what ``info.json`` says; the caller holds the lock.

    Returns:
        The committed state, and what was done.
    """
    check_fetched(root)
    remove_abandoned(real(root))
    completed = ["a change that was interrupted while its files were moved in"] if roll_forward(root) else []
    state = load_state(root)
    dropped: list[str] = []
    if state.identity is not None:
        if unfinished := continued_elsewhere(root):
            raise corrupt(unfinished[0], "another program continued this dataset and was killed")
        # Only in our own datasets: another program may know what its files are for.
        dropped = sorted(layout.recorded_files(root) - state.files())
        for name in dropped:
            disk.remove(root / name)
    if not keep_staging and (root / layout.STAGING).exists():
        staged = [path for path in (root / layout.STAGING).rglob("*") if path.is_file()]
        dropped += sorted(path.relative_to(root).as_posix() for path in staged)
        disk.remove_tree(root / layout.STAGING)
    # A task of a dropped episode may be in tasks.parquet already. It is not counted, and the next save writes the
    # file again, so it needs no step of its own.
    state.tasks = state.tasks[: state.info["total_tasks"]]
    return state, RepairReport(root, state.num_episodes, state.num_frames, tuple(completed), tuple(dropped))


def _check_deeply(state: DatasetState) -> None:
    _check_data(state)
    for key in state.video_keys:
        for slot, rows in ordered_slots(state.rows, f"videos/{key}").items():
            path = state.root / layout.video_file(key, slot)
            wanted = sum(row["length"] for row in rows)
            try:
                found = video.count_frames(path)
            except OSError as error:
                raise corrupt(path, error) from error
            if found != wanted:
                raise corrupt(path, f"it has {found} frames; its episodes have {wanted}")


def _check_data(state: DatasetState) -> None:
    """Check that every data file can be read to its last page, and holds the frames of its episodes."""
    for slot, rows in ordered_slots(state.rows, "data").items():
        path = state.root / layout.data_file(slot)
        try:
            file = pq.ParquetFile(path, page_checksum_verification=True)
            for group in range(file.num_row_groups):
                file.read_row_group(group, use_threads=False)
        except (OSError, pa.ArrowException) as error:
            raise corrupt(path, error) from error
        table, wanted = read_frames(path, list(NUMBERS)), numbers_of(rows)
        if not np.array_equal(np.sort(table["episode_index"].to_numpy()), wanted["episode_index"]):
            raise corrupt(path, wrong_number(table, wanted))
