"""`meta/info.json` of another recording in the place of one that is lost.

It describes the columns and the frame rate, which files without a footer do not. Its counts are those of the other
recording and are never used.
"""

from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.parquet_rescue import rescue
from bhd_lerobot.datasets.format.state import read_tasks
from bhd_lerobot.datasets.recovery.columns import misfit, read_info, wrong_rate
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.salvage import schema_of, shapes_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk, to_json
from bhd_lerobot.datasets.validate.findings import one_line
from bhd_lerobot.errors import ConfigError, DatasetCorruptError


def replace_info(root: Path, donor: Path, disk: Disk) -> tuple[str, Path | None]:
    """Describe a dataset by the `meta/info.json` of another; the caller holds the lock.

    What was there before goes to a folder beside the dataset.

    Returns:
        What was done, in a line, and where what was there before is now, if anything was.
    """
    donor = donor / layout.INFO if donor.is_dir() else donor
    path = root / layout.INFO
    if path.is_file() and donor.is_file() and path.samefile(donor):
        raise ConfigError(f"--info is {donor}, which is the dataset's own. Name that of another recording.")
    try:
        own = read_info(path)
    except DatasetCorruptError:
        own = None
    if own is not None and not _wrong(root, own):
        raise ConfigError(f"{path} can be read and fits its data. Leave --info out, and repair {root} without.")
    try:
        info = read_info(donor)
    except DatasetCorruptError as error:
        reason = one_line(error.__cause__ or error)
        raise ConfigError(
            f"--info is {donor}, which cannot be used: {reason}. Name another recording with the same robot and "
            "cameras, or its meta/info.json. Nothing was changed."
        ) from error
    if wrong := _wrong(root, info):
        raise ConfigError(
            f"--info is {donor}, which describes other data than those of {root}: {wrong}. Name a recording with the "
            "same robot and cameras. Nothing was changed."
        )
    saved: Path | None = None
    if path.exists():
        saved = layout.aside_of(root) / layout.INFO
        disk.make_folder(saved.parent)
        disk.copy(path, saved)
    rows = EpisodeRows(root).rows
    # Ours are numbered without a hole; what is behind one is for `salvage`, which counts by itself.
    total = next(index for index in range(len(rows) + 1) if index not in rows)
    try:
        tasks = len(read_tasks(root / layout.TASKS))
    except DatasetCorruptError:
        tasks = 0
    counted = {
        "total_episodes": total,
        "total_frames": sum(rows[index]["length"] for index in range(total)),
        "total_tasks": tasks,
        "splits": {"train": f"0:{total}"} if total else {},
    }
    disk.publish(path, to_json({**info, **counted}), root / layout.STAGING)
    return f"{layout.INFO}: columns and frame rate as in {donor}, counts from the files", saved


def restore_info(root: Path, saved: Path | None, disk: Disk) -> None:
    """Undo what `replace_info` did."""
    if saved is None:
        disk.remove(root / layout.INFO)
    else:
        disk.move(saved, root / layout.INFO)
        disk.remove_tree(saved.parents[1])


def _wrong(root: Path, info: dict[str, Any]) -> str:
    """Return in which way a dataset's files contradict an `info.json`; empty if they do not."""
    if wrong := misfit(root, info):
        return wrong
    schema, shapes = schema_of(root, info), shapes_of(info)
    paths = sorted((root / "data").glob("chunk-*/file-*.parquet"))
    for path in paths:
        try:
            groups = rescue(path, schema, shapes).groups
        except (OSError, ValueError):
            continue
        if groups:
            return wrong_rate(info, groups[-1])
    return f"with its columns no frame of {len(paths)} data files can be read" if paths else ""
