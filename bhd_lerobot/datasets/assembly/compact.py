"""From one file per episode to few files, in one step that a kill cannot leave half done.

New folders are built beside the old ones; files that need no change are linked. See
`bhd_lerobot.datasets.storage.atomic`.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format import statistics, video
from bhd_lerobot.datasets.format.episode_table import stored_stats
from bhd_lerobot.datasets.format.meta_files import MEBIBYTE, PARQUET_OPTIONS, write_meta
from bhd_lerobot.datasets.format.schema import Schema, as_numpy
from bhd_lerobot.datasets.format.state import (
    DatasetState,
    Row,
    corrupt,
    ordered_slots,
    read_frames,
    slot_columns,
    slot_of,
)
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import Workspace, link_others
from bhd_lerobot.datasets.storage.disk import Disk, RootLock
from bhd_lerobot.datasets.storage.layout import Slot

EpisodeStats = dict[str, statistics.Stats]


@dataclass
class _Group:
    """Files of one kind that become one file."""

    target: Slot
    sources: list[Slot]

    @property
    def unchanged(self) -> bool:
        return self.sources == [self.target]


def compact(
    state: DatasetState, schema: Schema, disk: Disk, lock: RootLock, known: Mapping[int, EpisodeStats] | None = None
) -> bool:
    """Compact a dataset and store all statistics.

    Args:
        state: what is on disk now.
        schema: its columns.
        disk: how to write.
        lock: of the dataset.
        known: statistics of episodes that are still in memory; those of others are computed from their data.

    Returns:
        False if there was nothing to do.

    Raises:
        OSError: a file cannot be written; the dataset is then as it was.
        DatasetCorruptError: a file cannot be read.
    """
    data = _data_groups(state)
    videos = {key: _video_groups(state, key) for key in state.video_keys}
    moved = any(not group.unchanged for groups in (data, *videos.values()) for group in groups)
    if not state.rows or (not moved and not state.without_stats and (state.root / layout.STATS).exists()):
        return False
    with Workspace(state.root, disk, lock) as space:
        stats = _all_stats(state, schema, known or {})
        rows = [dict(row) for row in state.rows]
        _build_data(state, schema, disk, data, rows, new=space.folder)
        _build_videos(state, disk, videos, rows, new=space.folder)
        _build_meta(state, disk, rows, stats, new=space.folder)
        space.publish(f"the files of {state.root} had been merged")
    return True


def _groups(sizes: Mapping[Slot, int], limit: float, chunks_size: int, split: Callable[[Slot], bool]) -> list[_Group]:
    """Pack files in order, as many into one as fit below `limit` bytes; `split` says that a file must start anew."""
    groups: list[_Group] = []
    filled = 0
    for slot, size in sizes.items():
        if not groups or filled + size >= limit or split(slot):
            groups.append(_Group(layout.next_slot(groups[-1].target if groups else None, chunks_size), []))
            filled = 0
        groups[-1].sources.append(slot)
        filled += size
    return groups


def _data_groups(state: DatasetState) -> list[_Group]:
    sizes = {slot: (state.root / layout.data_file(slot)).stat().st_size for slot in ordered_slots(state.rows, "data")}
    limit = state.info["data_files_size_in_mb"] * MEBIBYTE
    return _groups(sizes, limit, state.info["chunks_size"], lambda slot: False)


def _video_groups(state: DatasetState, key: str) -> list[_Group]:
    paths = {slot: state.root / layout.video_file(key, slot) for slot in ordered_slots(state.rows, f"videos/{key}")}
    signatures = {slot: video.stream_signature(path) for slot, path in paths.items()}
    previous: list[Slot] = []

    def differs(slot: Slot) -> bool:
        before = previous[-1] if previous else slot
        previous.append(slot)
        return signatures[before] != signatures[slot]

    limit = state.info["video_files_size_in_mb"] * MEBIBYTE
    sizes = {slot: path.stat().st_size for slot, path in paths.items()}
    return _groups(sizes, limit, state.info["chunks_size"], differs)


def _build_data(
    state: DatasetState, schema: Schema, disk: Disk, groups: list[_Group], rows: list[Row], *, new: Path
) -> None:
    if all(group.unchanged for group in groups):
        return
    targets = {source: group.target for group in groups for source in group.sources}
    link_others(state.root / "data", new / "data", disk, "chunk-*/file-*.parquet")
    for group in groups:
        target = new / layout.data_file(group.target)
        disk.make_folder(target.parent)
        sources = [state.root / layout.data_file(source) for source in group.sources]
        if len(sources) == 1:
            disk.link(sources[0], target)
        else:
            _merge_parquet(sources, target, schema.arrow, disk)
    for row in rows:
        row.update(slot_columns("data", targets[slot_of(row, "data")]))


def _merge_parquet(sources: list[Path], target: Path, schema: pa.Schema, disk: Disk) -> None:
    """Write the row groups of several files into one; readers fetch an episode as one row group."""
    disk.write(target, b"")
    with pq.ParquetWriter(target, schema, **PARQUET_OPTIONS) as writer:
        for source in sources:
            for table in _row_groups(source):
                same = table.schema.equals(schema, check_metadata=True)
                writer.write_table(table if same else table.select(schema.names).cast(schema))
    disk.flush(target)


def _row_groups(source: Path) -> Iterator[pa.Table]:
    """Read a file group by group. Arrow reports damaged pages as an OSError; here it cannot mean a full disk."""
    try:
        file = pq.ParquetFile(source, page_checksum_verification=True)
        for group in range(file.num_row_groups):
            yield file.read_row_group(group, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise corrupt(source, error) from error


def _build_videos(
    state: DatasetState, disk: Disk, videos: Mapping[str, list[_Group]], rows: list[Row], *, new: Path
) -> None:
    if all(group.unchanged for groups in videos.values() for group in groups):
        return
    fps = state.info["fps"]
    link_others(state.root / "videos", new / "videos", disk, "*/chunk-*/file-*.mp4")
    for key, groups in videos.items():
        kind = f"videos/{key}"
        by_slot = ordered_slots(rows, kind)
        for group in groups:
            target = new / layout.video_file(key, group.target)
            disk.make_folder(target.parent)
            sources = [state.root / layout.video_file(key, source) for source in group.sources]
            lengths = [sum(row["length"] for row in by_slot[source]) for source in group.sources]
            if len(sources) == 1:
                disk.link(sources[0], target)
            else:
                disk.write(target, b"")
                for source, found, wanted in zip(
                    sources, video.concatenate(sources, target, fps), lengths, strict=True
                ):
                    if found != wanted:
                        raise corrupt(source, f"it has {found} frames; its episodes have {wanted}")
                disk.flush(target)
            start = 0
            for row in (row for source in group.sources for row in by_slot[source]):
                row.update(slot_columns(kind, group.target))
                row[f"{kind}/from_timestamp"] = start / fps
                start += row["length"]
                row[f"{kind}/to_timestamp"] = start / fps


def _build_meta(
    state: DatasetState, disk: Disk, rows: list[Row], stats: Mapping[str, statistics.Stats], *, new: Path
) -> None:
    link_others(state.root / "meta", new / "meta", disk, "episodes/chunk-*/file-*.parquet", "stats.json")
    limit = state.info["data_files_size_in_mb"] * MEBIBYTE
    # Full files whose rows did not change are kept; everything after the first other one is written again.
    done, slot = 0, None
    for source, old_rows in ordered_slots(state.rows, "meta/episodes").items():
        path = state.root / layout.episodes_file(source)
        following = layout.next_slot(slot, state.info["chunks_size"])
        if source != following or old_rows != rows[done : done + len(old_rows)] or path.stat().st_size < limit / 2:
            break
        if state.without_stats.intersection(row["episode_index"] for row in old_rows):
            break
        disk.make_folder((new / layout.episodes_file(source)).parent)
        disk.link(path, new / layout.episodes_file(source))
        done, slot = done + len(old_rows), source
    write_meta(
        new, state.info, rows, state.metadata_types, stats, disk=disk, extra=state.extra_types, done=done, slot=slot
    )


def _all_stats(state: DatasetState, schema: Schema, known: Mapping[int, EpisodeStats]) -> dict[str, statistics.Stats]:
    """Return feature -> statistic -> values of all episodes, shape (E, ...)."""
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
        unknown += [row for row in rows if row["episode_index"] in state.without_stats]
    for slot, rows in ordered_slots(unknown, "data").items():
        _stats_from_data(state, schema, slot, rows, result)
    return result


def _stats_from_data(
    state: DatasetState, schema: Schema, slot: Slot, rows: list[Row], result: dict[str, statistics.Stats]
) -> None:
    path = state.root / layout.data_file(slot)
    try:
        wanted = pa.schema([schema.arrow.field(key) for key in schema.float_keys])
        table = read_frames(path, schema.float_keys).select(schema.float_keys).cast(wanted)
    except (pa.ArrowException, ValueError) as error:
        raise corrupt(path, error) from error
    first = min(row["dataset_from_index"] for row in state.rows if slot_of(row, "data") == slot)
    columns = {key: as_numpy(table[key]) for key in schema.float_keys}
    for row in rows:
        span = slice(row["dataset_from_index"] - first, row["dataset_to_index"] - first)
        _store(result, row["episode_index"], statistics.column_stats({k: v[span] for k, v in columns.items()}))


def _store(result: dict[str, statistics.Stats], episode: int, stats: EpisodeStats) -> None:
    for key, stat in stats.items():
        for name, values in stat.items():
            result[key][name][episode] = values
