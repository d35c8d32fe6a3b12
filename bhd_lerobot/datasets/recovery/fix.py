"""`bhd-data check --fix`: repair what follows from the rest of a dataset, and nothing else.

Statistics follow from the frames, the number of frames from the episodes, and the order of files, rows and
instructions from their numbers. What is damaged is for `repair`, and what is uncertain, such as a value that is out of
range, is for a person.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.assembly.assemble import SORTED, assemble, logged_now
from bhd_lerobot.datasets.assembly.compact import episode_stats
from bhd_lerobot.datasets.assembly.picks import Pick
from bhd_lerobot.datasets.format.columns import frames_of
from bhd_lerobot.datasets.format.episode_table import stored_stats
from bhd_lerobot.datasets.format.meta_files import write_meta
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import DatasetState, load_info, load_state, ordered_slots
from bhd_lerobot.datasets.format.statistics import Stats
from bhd_lerobot.datasets.recovery.statistics import stats_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import Workspace, has_unfinished_episodes, link_others, real, remove_abandoned
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.datasets.validate.findings import FIX, Finding, Severity


def is_fixable(finding: Finding) -> bool:
    """Return whether `fix` repairs what was found: what its remedy says."""
    return finding.severity is not Severity.NOTE and FIX in finding.remedy


def fix(root: Path | str, findings: Sequence[Finding]) -> list[str]:
    """Repair what can be repaired, if everything that it follows from is valid; return a line for each thing.

    A kill at any moment leaves either the old dataset or the new one.
    """
    root = Path(root)
    wanted = [finding for finding in findings if is_fixable(finding)]
    remove_abandoned(real(root))
    if not wanted or any(finding.severity is Severity.ERROR and not is_fixable(finding) for finding in findings):
        return []
    lock = RootLock(root)
    try:
        if has_unfinished_episodes(root):
            return []  # an interrupted recording, which is for `repair`
        with write_errors("repair the dataset", root, "It is as it was."):
            order = any(finding.check != "stats" and finding.where != layout.INFO for finding in wanted)
            stats = any(finding.check == "stats" for finding in wanted)
            return rebuild(load_state(root, counted=False), Disk(), lock, order=order, stats=stats)
    finally:
        lock.release()


def rebuild(state: DatasetState, disk: Disk, lock: RootLock, *, order: bool = False, stats: bool = False) -> list[str]:
    """Count the frames, and write anew what follows from them, in one step; return a line for each thing.

    Args:
        order: whether files, rows and instructions are put in the order of their numbers, and the frames numbered.
        stats: whether the statistics of all episodes are computed.
    """
    root, counted, done = state.root, load_info(state.root)["total_frames"], []
    info = {**state.info, "total_frames": state.num_frames}
    if counted != state.num_frames:
        done.append(f"{layout.INFO}: total_frames is {state.num_frames}, as in the episodes; it was {counted}")
    rows = [dict(row) for row in state.rows]
    known = compute_stats(state) if stats or (order and state.without_stats) else None
    with Workspace(root, disk, lock) as space:
        new = space.folder
        if order:
            picks = [Pick(state, row) for row in state.rows]
            edit = logged_now({"edit": SORTED, "episodes": list(range(state.num_episodes))})
            assemble(picks, new, disk, in_place=True, edit=edit, identity=state.identity, known=known)
            done.append("data, meta/episodes and meta/tasks.parquet: in the order of their numbers")
        else:
            skipped = ("episodes/chunk-*/file-*.parquet", "stats.json") if known is not None else ()
            link_others(root / "meta", new / "meta", disk, "info.json", *skipped)
            if known is not None:
                write_meta(new, info, rows, state.metadata_types, known, disk=disk, extra=state.extra_types)
            disk.write(new / layout.INFO, to_json(info))
        if known is not None:
            done.append(f"{layout.STATS} and meta/episodes: statistics of {len(rows)} episodes, from their frames")
        space.publish(f"the correction of {root} had been completed")
    disk.try_remove_tree(root / layout.STAGING)
    return done


def compute_stats(state: DatasetState) -> Mapping[str, Stats]:
    """Return feature -> statistic -> values of all episodes, shape (E, ...), computed from their frames."""
    if state.identity is not None:
        state.without_stats = set(range(state.num_episodes))
        return episode_stats(state, Schema(state.info["features"]), {})
    return stats_of(_tables(state), state.info["features"], state.root, state.rows, _stored_depth(state))


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
    for slot, rows in ordered_slots(state.rows, "data").items():
        frames = frames_of(state.root / layout.data_file(slot), rows)
        yield from (frames[row["episode_index"]] for row in rows)
