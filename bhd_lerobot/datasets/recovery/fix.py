"""`bhd-data check --fix`: repair what follows from the rest of a dataset, and nothing else.

Statistics follow from the frames, and the number of frames from the episodes. What is damaged is for `repair`, and what
is uncertain, such as a value that is out of range, is for a person.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.compact import compact
from bhd_lerobot.datasets.format.episode_table import stored_stats
from bhd_lerobot.datasets.format.meta_files import write_meta
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import DatasetState, corrupt, load_info, load_state, ordered_slots, read_frames
from bhd_lerobot.datasets.recovery.statistics import stats_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import Workspace, has_unfinished_episodes, link_others, real, remove_abandoned
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.datasets.validate.findings import Finding, Severity


def is_fixable(finding: Finding) -> bool:
    """Return whether `fix` repairs what was found."""
    if finding.severity is Severity.NOTE:
        return False
    return finding.check == "stats" or (finding.check == "counts" and finding.where == layout.INFO)


def fix(root: Path | str, findings: Sequence[Finding]) -> list[str]:
    """Repair what can be repaired, if everything that it follows from is valid; return a line for each thing.

    Args:
        root: the dataset.
        findings: what `check_dataset` found there.

    Raises:
        DatasetLockedError: it is being recorded.
        DatasetCorruptError: a file cannot be read; nothing was changed.
        DatasetWriteError: the disk refuses; the dataset is as it was.
    """
    root = Path(root)
    wanted = [finding for finding in findings if is_fixable(finding)]
    remove_abandoned(real(root))
    if has_unfinished_episodes(root):
        return []  # an interrupted recording, which is for `repair`
    if not wanted or any(finding.severity is Severity.ERROR and not is_fixable(finding) for finding in findings):
        return []
    disk = Disk()
    lock = RootLock(root)
    done: list[str] = []
    try:
        with write_errors("repair the dataset", root, "It is as it was."):
            if any(finding.check == "counts" for finding in wanted):
                done.append(_count_frames(root, disk))
            if any(finding.check == "stats" for finding in wanted):
                done.append(compute_stats(load_state(root), disk, lock))
            disk.remove_tree(root / layout.STAGING)
    finally:
        lock.release()
    return done


def _count_frames(root: Path, disk: Disk) -> str:
    info = load_info(root)
    frames = 0
    for path in sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet")):
        try:
            table = pq.ParquetFile(path).read(columns=["episode_index", "length"], use_threads=False)
        except (OSError, pa.ArrowException) as error:
            raise corrupt(path, error) from error
        rows = zip(table["episode_index"].to_pylist(), table["length"].to_pylist(), strict=True)
        frames += sum(length for index, length in rows if index < info["total_episodes"])
    before = info["total_frames"]
    disk.publish(root / layout.INFO, to_json({**info, "total_frames": frames}), root / layout.STAGING)
    return f"{layout.INFO}: total_frames is {frames}, as the episodes say; it was {before}"


def compute_stats(state: DatasetState, disk: Disk, lock: RootLock) -> str:
    """Compute the statistics of all episodes from their frames, store them, and return what was done in a line."""
    if state.identity is not None:
        state.without_stats = set(range(state.num_episodes))
        compact(state, Schema(state.info["features"]), disk, lock)
    else:
        rows = [dict(row) for row in state.rows]
        depth = _stored_depth(state)
        stats = stats_of(_tables(state), state.info["features"], state.root, rows, depth)
        skipped = ("episodes/chunk-*/file-*.parquet", "stats.json")
        with Workspace(state.root, disk, lock) as space:
            new = space.folder
            link_others(state.root / "meta", new / "meta", disk, *skipped)
            write_meta(new, state.info, rows, state.metadata_types, stats, disk=disk, extra=state.extra_types)
            space.publish(f"the statistics of {state.root} had been computed")
    return f"{layout.STATS} and meta/episodes: statistics of {state.num_episodes} episodes, computed from their frames"


def _stored_depth(state: DatasetState) -> list[dict[str, dict[str, np.ndarray]]]:
    """Return the statistics of depth images of every episode, which cannot be computed here."""
    found: list[dict[str, dict[str, np.ndarray]]] = [{} for _ in state.rows]
    for slot, rows in ordered_slots(state.rows, "meta/episodes").items():
        order, stored = stored_stats(state.root / layout.episodes_file(slot))
        places = {index: place for place, index in enumerate(order)}
        for row in rows:
            place = places[row["episode_index"]]
            for key, stat in stored.items():
                feature = state.info["features"].get(key, {})
                if feature.get("dtype") in ("video", "image") and 3 not in (feature["shape"][0], feature["shape"][-1]):
                    found[row["episode_index"]][key] = {name: values[place] for name, values in stat.items()}
    return found


def _tables(state: DatasetState) -> Iterator[pa.Table]:
    """Yield the frames of every episode."""
    for slot, rows in ordered_slots(state.rows, "data").items():
        table = read_frames(state.root / layout.data_file(slot))
        first = rows[0]["dataset_from_index"]
        for row in rows:
            yield table.slice(row["dataset_from_index"] - first, row["length"])
