"""From one file per episode to few files, in one step that a kill cannot leave half done.

New folders are built beside the old ones; files that need no change are linked. See
`bhd_lerobot.datasets.storage.atomic`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.files import build_data, build_videos, data_groups, video_groups
from bhd_lerobot.datasets.assembly.picks import Files, Pick, Plan
from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.columns import frames_of, to_numpy
from bhd_lerobot.datasets.format.episode_table import stored_stats
from bhd_lerobot.datasets.format.meta_files import MEBIBYTE, write_meta
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import DatasetState, Row, corrupt, ordered_slots
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import Workspace, link_others
from bhd_lerobot.datasets.storage.disk import Disk, RootLock

EpisodeStats = dict[str, statistics.Stats]


def compact(
    state: DatasetState, schema: Schema, disk: Disk, lock: RootLock, known: Mapping[int, EpisodeStats] | None = None
) -> bool:
    """Compact a dataset and store all statistics; return False if there was nothing to do.

    Episodes whose statistics are stored were merged with them. Their files become smaller on the way, so that two that
    were too large for one may not be any more: they stay as they are, or a second call would never have nothing to do.
    """
    if not state.rows or (not state.without_stats and (state.root / layout.STATS).exists()):
        return False
    picks, rows = [Pick(state, row) for row in state.rows], [dict(row) for row in state.rows]
    plan = Plan(picks, rows, {task: index for index, task in enumerate(state.tasks)}, state.info, Files(picks))
    data = data_groups(plan)
    videos = {key: video_groups(plan, key) for key in state.video_keys}
    move_data = not all(group.is_in_place for group in data)
    move_videos = not all(group.is_in_place for groups in videos.values() for group in groups)
    with Workspace(state.root, disk, lock) as space:
        stats = episode_stats(state, schema, known or {})
        if move_data:
            link_others(state.root / "data", space.folder / "data", disk, "chunk-*/file-*.parquet")
            build_data(plan, data, space.folder, disk, take=disk.link, schema=schema.arrow)
        if move_videos:
            link_others(state.root / "videos", space.folder / "videos", disk, "*/chunk-*/file-*.mp4")
            for key, groups in videos.items():
                build_videos(plan, key, groups, space.folder, disk, take=disk.link)
        _build_meta(state, disk, rows, stats, new=space.folder)
        space.publish(f"the files of {state.root} had been merged")
    return True


def _build_meta(
    state: DatasetState, disk: Disk, rows: list[Row], stats: Mapping[str, statistics.Stats], *, new: Path
) -> None:
    link_others(state.root / "meta", new / "meta", disk, "episodes/chunk-*/file-*.parquet", "stats.json")
    limit = state.info["data_files_size_in_mb"] * MEBIBYTE
    # Full files whose rows did not change are kept; everything after the first other one is written again.
    done, slot = 0, None
    columns = {f"stats/{key}/{name}" for key, stat in stats.items() for name in stat}
    for source, old_rows in ordered_slots(state.rows, "meta/episodes").items():
        path = state.root / layout.episodes_file(source)
        following = layout.next_slot(slot, state.info["chunks_size"])
        if source != following or old_rows != rows[done : done + len(old_rows)] or path.stat().st_size < limit / 2:
            break
        if state.without_stats.intersection(row["episode_index"] for row in old_rows):
            break
        if {name for name in pq.read_schema(path).names if name.startswith("stats/")} != columns:
            break  # LeRobot loads only files that have the same
        disk.make_folder((new / layout.episodes_file(source)).parent)
        disk.link(path, new / layout.episodes_file(source))
        done, slot = done + len(old_rows), source
    write_meta(
        new, state.info, rows, state.metadata_types, stats, disk=disk, extra=state.extra_types, done=done, slot=slot
    )


def episode_stats(
    state: DatasetState, schema: Schema, known: Mapping[int, EpisodeStats]
) -> dict[str, statistics.Stats]:
    """Return feature -> statistic -> values of all episodes, shape (E, ...); see `compact`."""
    result: dict[str, statistics.Stats] = {}
    for key in [*schema.float_keys, *schema.videos]:
        width = (3, 1, 1) if key in schema.videos else tuple(schema.features[key]["shape"])
        result[key] = {
            name: np.empty((state.num_episodes, 1), np.int64)
            if name == "count"
            else np.empty((state.num_episodes, *width))
            for name in statistics.STATISTICS
        }
    unknown: list[Row] = []
    for slot, rows in ordered_slots(state.rows, "meta/episodes").items():
        if all(row["episode_index"] in known for row in rows):
            for row in rows:
                _store(result, row["episode_index"], known[row["episode_index"]])
            continue
        order, stored = stored_stats(state.root / layout.episodes_file(slot))
        places = [i for i, index in enumerate(order) if index is not None and 0 <= index < state.num_episodes]
        for key, stat in stored.items():
            for name, values in stat.items():
                if name in result.get(key, {}):
                    if values.shape[1:] != result[key][name].shape[1:]:
                        what = f"its statistic {name} of {key!r} has another shape than the feature"
                        raise corrupt(state.root / layout.episodes_file(slot), what)
                    result[key][name][[order[i] for i in places]] = values[places]
        # Another program may store fewer of them: those of columns are computed, those of images are left out.
        names = statistics.STATISTICS
        lacks = any(name not in stored.get(key, {}) for key in schema.float_keys for name in names)
        unknown += [row for row in rows if lacks or row["episode_index"] in state.without_stats]
        for key in schema.videos:
            result[key] = {name: values for name, values in result[key].items() if name in stored.get(key, {})}
    files = ordered_slots(state.rows, "data") if unknown else {}
    for slot, rows in ordered_slots(unknown, "data").items():
        path = state.root / layout.data_file(slot)
        frames = frames_of(path, files[slot], schema.float_keys)
        for row in rows:
            stats = _stats_from_data(schema, frames[row["episode_index"]], path)
            _store(result, row["episode_index"], stats)
    return {key: stat for key, stat in result.items() if stat}


def _stats_from_data(schema: Schema, frames: pa.Table, path: Path) -> EpisodeStats:
    try:
        wanted = pa.schema([schema.arrow.field(key) for key in schema.float_keys])
        table = frames.select(schema.float_keys).cast(wanted)
    except (pa.ArrowException, ValueError) as error:
        raise corrupt(path, error) from error
    return statistics.column_stats({key: to_numpy(table[key]) for key in schema.float_keys})


def _store(result: dict[str, statistics.Stats], episode: int, stats: EpisodeStats) -> None:
    for key, stat in stats.items():
        for name in stat.keys() & result[key].keys():
            result[key][name][episode] = stat[name]
