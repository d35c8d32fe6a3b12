"""A dataset made of episodes of others: what merging, filtering, splitting, deleting and marking have in common.

LeRobot's own tools encode videos again when they take episodes out of one, write without the columns of
``meta/episodes`` that they do not know, and leave a half dataset behind a kill. Here videos are cut without encoding,
every column comes along, and the new dataset appears complete or not at all. Files that stay as they are are linked.
"""

import copy
import datetime
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.files import build_data, build_videos, data_groups, video_groups
from bhd_lerobot.datasets.assembly.picks import Files, Pick, Plan
from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.columns import frames_of, to_numpy
from bhd_lerobot.datasets.format.episode_table import PREFIX, stored_stats
from bhd_lerobot.datasets.format.identity import comparable, differences
from bhd_lerobot.datasets.format.meta_files import tasks_table, write_meta
from bhd_lerobot.datasets.format.state import DatasetState, Row, corrupt, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import has_unfinished_episodes, link_others
from bhd_lerobot.datasets.storage.disk import Disk, to_json
from bhd_lerobot.datasets.storage.layout import Slot
from bhd_lerobot.errors import DatasetError, DatasetMismatchError, quoted

EDITS = "meta/edits.jsonl"
"""What was done to a dataset after its recording: one JSON object a line."""

SORTED = "sort"
"""Name of the edit that puts files, rows and instructions in the order of their numbers, which stay what they are."""

WRITTEN = (
    "info.json",
    "stats.json",
    "tasks.parquet",
    "bhd.json",
    "edits.jsonl",
    "bhd_subset.json",  # the episodes of a pull, which an edited dataset does not have any more
    "episodes/chunk-*/file-*.parquet",
)
"""Files of ``meta`` that are rewritten with every change of episodes; all others are copied."""


def assemble(
    picks: Sequence[Pick],
    new: Path,
    disk: Disk,
    *,
    types: Mapping[str, pa.DataType] | None = None,
    in_place: bool = False,
    edit: Mapping[str, Any],
    identity: Mapping[str, Any] | None,
    known: Mapping[str, statistics.Stats] | None = None,
) -> None:
    """Write a dataset.

    Args:
        types: Arrow types of metadata columns that no source has, by name without prefix.
        in_place: the new content takes the place of the only source's. Then files that stay are linked; two datasets
            never share one, because other programs write into files.
        known: feature -> statistic -> values of all episodes of the only source; those that are stored if None.
    """
    sources = _sources(picks, known is not None)
    check_alike(sources)
    kinds = {**_types(sources, "metadata_types", PREFIX), **(types or {})}
    extra = _types(sources, "extra_types", "")
    files = Files(picks)
    instructions = [files.instructions(pick) for pick in picks]
    tasks = _tasks(sources, picks, instructions)
    info = _info(sources, len(picks), sum(pick.row["length"] for pick in picks), len(tasks))
    rows = _rows(picks, instructions, kinds, extra)
    plan = Plan(picks, rows, tasks, info, files)
    take = disk.link if in_place else disk.copy
    build_data(plan, data_groups(plan), new, disk, take=take)
    for key in sources[0].video_keys:
        build_videos(plan, key, video_groups(plan, key), new, disk, take=take)
    disk.make_folder(new / "meta")
    if len(sources) == 1:
        link_others(sources[0].root / "meta", new / "meta", disk, *WRITTEN, take=take)
    if in_place:
        link_others(sources[0].root / "data", new / "data", disk, "chunk-*/file-*.parquet")
        if (sources[0].root / "videos").is_dir():
            link_others(sources[0].root / "videos", new / "videos", disk, "*/chunk-*/file-*.mp4")
    sink = pa.BufferOutputStream()
    pq.write_table(tasks_table(list(tasks)), sink)
    disk.write(new / layout.TASKS, memoryview(sink.getvalue()))
    write_meta(new, info, rows, kinds, _stats(plan, known), disk=disk, extra=extra)
    if identity is not None:
        disk.write(new / layout.IDENTITY, to_json(identity))
    lines = [line for source in sources for line in edit_lines(source.root)] + [json.dumps(edit, ensure_ascii=False)]
    disk.write(new / EDITS, "".join(f"{line}\n" for line in lines).encode())
    disk.write(new / layout.INFO, to_json(info))


def logged_now(edit: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of ``meta/edits.jsonl`` with the present time."""
    return {"time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"), **edit}


def check_alike(sources: Sequence[DatasetState]) -> None:
    """Check that episodes of several datasets can be in one."""
    first = sources[0]
    for other in sources[1:]:
        found = list(differences("", _kind(first), _kind(other)))
        if found:
            lines = "\n  ".join(line.replace("recorded", "there").replace("requested", "here") for line in found)
            raise DatasetMismatchError(
                f"{other.root} does not fit {first.root}:\n  {lines}\nOnly datasets with the same robot, frame rate "
                "and features can be merged. lerobot-edit-dataset can remove features from one of them."
            )


def _kind(state: DatasetState) -> dict[str, Any]:
    features = comparable(state.info["features"])
    return {
        "fps": state.info["fps"],
        "robot_type": state.info.get("robot_type"),
        "features": {
            key: {
                **{name: feature.get(name) for name in ("dtype", "shape", "names")},
                # The encoding of depth; other descriptions of a video may differ.
                **{n: v for n, v in (state.info["features"][key].get("info") or {}).items() if _is_meaning(n)},
            }
            for key, feature in features.items()
        },
    }


def _is_meaning(name: str) -> bool:
    return "depth" in name or name.removeprefix("video.") in ("shift", "use_log")


def _sources(picks: Sequence[Pick], has_stats: bool) -> list[DatasetState]:
    if not picks:
        raise DatasetError("No episode is left, and a dataset needs one. Nothing was changed.")
    sources: list[DatasetState] = []
    for pick in picks:
        if not any(pick.source is source for source in sources):
            sources.append(pick.source)
    for source in sources if not has_stats else ():
        if has_unfinished_episodes(source.root) or (source.without_stats and source.identity is not None):
            raise DatasetError(
                f"{source.root} is not finalised: its recording was interrupted, or is still running. Run `bhd-data "
                f"repair {quoted(source.root)}` first."
            )
        if source.without_stats:
            raise DatasetError(
                f"{source.root} has no statistics of single episodes. Run `bhd-data check --fix "
                f"{quoted(source.root)}` first."
            )
    return sources


def _types(sources: Sequence[DatasetState], name: str, prefix: str) -> dict[str, pa.DataType]:
    types: dict[str, pa.DataType] = {}
    for source in sources:
        for column, kind in getattr(source, name).items():
            if types.setdefault(column, kind) != kind:
                raise DatasetMismatchError(
                    f"{source.root}: the metadata {prefix}{column} of its episodes is {kind}; in {sources[0].root} it "
                    f"is {types[column]}. They cannot be merged into one column."
                )
    return types


def _tasks(
    sources: Sequence[DatasetState], picks: Sequence[Pick], instructions: Sequence[Sequence[str]]
) -> dict[str, int]:
    """Return the index of each instruction that is used: those of the first dataset in its order, then the next's."""
    tasks: dict[str, None] = {}
    for source in sources:
        used = {task for pick, own in zip(picks, instructions, strict=True) if pick.source is source for task in own}
        tasks |= dict.fromkeys(task for task in source.tasks if task in used)
    return {task: index for index, task in enumerate(tasks)}


def _info(sources: Sequence[DatasetState], episodes: int, frames: int, tasks: int) -> dict[str, Any]:
    info = copy.deepcopy(sources[0].info)
    for key, feature in info["features"].items():
        infos = [source.info["features"][key].get("info") or {} for source in sources]
        if any(infos):
            # Values that differ between the encoders are unknown for the mixture.
            feature["info"] = {
                name: value if all(other.get(name) == value for other in infos) else None
                for name, value in infos[0].items()
            }
    return info | {
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "splits": {"train": f"0:{episodes}"},
        "data_path": layout.DATA_PATH,
        "video_path": layout.VIDEO_PATH if info.get("video_path") else info.get("video_path"),
    }


def _rows(
    picks: Sequence[Pick], instructions: Sequence[Sequence[str]], types: Iterable[str], extra: Iterable[str]
) -> list[Row]:
    rows, start = [], 0
    for index, (pick, tasks) in enumerate(zip(picks, instructions, strict=True)):
        length = pick.row["length"]
        row = {"episode_index": index, "tasks": list(tasks), "length": length}
        row |= {"dataset_from_index": start, "dataset_to_index": start + length}
        row |= {PREFIX + name: pick.metadata.get(name, pick.row.get(PREFIX + name)) for name in types}
        row |= {name: pick.row.get(name) for name in extra}
        rows.append(row)
        start += length
    return rows


def _stats(plan: Plan, known: Mapping[str, statistics.Stats] | None) -> dict[str, statistics.Stats]:
    """Return feature -> statistic -> values of all episodes, shape (E, ...): the old ones where nothing changed."""
    files: dict[tuple[int, Slot], tuple[dict[int, int], dict[str, statistics.Stats]]] = {}
    read: dict[tuple[int, Slot], dict[int, pa.Table]] = {}  # of one data file: its episodes follow each other
    stacked: dict[str, dict[str, list[np.ndarray]]] = {}
    for place, pick in enumerate(plan.picks):
        slot = slot_of(pick.row, "meta/episodes")
        if (id(pick.source), slot) not in files:
            path = pick.source.root / layout.episodes_file(slot)
            order, stored = stored_stats(path) if known is None else (range(len(pick.source.rows)), dict(known))
            files[id(pick.source), slot] = {index: place for place, index in enumerate(order)}, stored
        places, stored = files[id(pick.source), slot]
        index = places[pick.row["episode_index"]]
        own = {key: {name: values[index] for name, values in stat.items()} for key, stat in stored.items()}
        row = plan.rows[place]
        columns: dict[str, np.ndarray] = _impossible(plan, place, own, read) | {
            "episode_index": np.full(row["length"], place),
            "index": np.arange(row["dataset_from_index"], row["dataset_to_index"]),
            "task_index": plan.task_indexes(place),
            **pick.columns,
        }
        # What another program stored may hold what is not finite.
        fresh = statistics.column_stats({key: one for key, one in columns.items() if key in own}, finite=False)
        for key, stat in {**own, **fresh}.items():
            for name in own[key]:
                stacked.setdefault(key, {}).setdefault(name, []).append(stat.get(name, own[key][name]))
    for key, stat in stacked.items():
        for name, values in stat.items():
            if len({np.shape(value) for value in values}) > 1:
                raise DatasetMismatchError(
                    f"The statistic {name} of {key} has {np.size(values[0])} numbers in one episode, and a different "
                    "number in others. `lerobot-edit-dataset --operation.type recompute_stats` computes them."
                )
            if len(values) != len(plan.picks):
                # Later files of LeRobot's would have more columns than these, and nothing would load any more.
                raise DatasetMismatchError(
                    f"Only some of the datasets have the statistic {name} of {key}; the others are older than this "
                    "statistic. `lerobot-edit-dataset --operation.type recompute_stats` computes all of them."
                )
    return {key: {name: np.stack(values) for name, values in stat.items()} for key, stat in stacked.items()}


def _impossible(
    plan: Plan, place: int, stats: Mapping[str, statistics.Stats], read: dict[tuple[int, Slot], dict[int, pa.Table]]
) -> dict[str, np.ndarray]:
    """Return the columns of an episode whose stored standard deviation cannot be theirs, each of shape (T, d).

    Args:
        read: the frames of the episodes of the data file that was read last.
    """
    source, row = plan.picks[place].source, plan.picks[place].row
    features = source.info["features"]
    judged = [
        key
        for key in stats.keys() & features.keys()
        if features[key]["dtype"] not in ("image", "video") and len(features[key]["shape"]) == 1
    ]
    wrong = [key for key in judged if not statistics.are_possible(stats[key]).all()]
    if not wrong:
        return {}
    slot = slot_of(row, "data")
    if (file := (id(source), slot)) not in read:
        read.clear()
        read[file] = frames_of(source.root / layout.data_file(slot), plan.files.rows(source, "data")[slot], judged)
    frames = read[file][row["episode_index"]]
    return {key: to_numpy(frames[key], tuple(features[key]["shape"])) for key in wrong}


def edit_lines(root: Path) -> list[str]:
    """Return the edits of a dataset, a line of JSON each, oldest first; none if there are none."""
    path = root / EDITS
    try:  # Python's lines end at characters, too, that a note may hold as they are
        return [line for line in path.read_text(encoding="utf-8").split("\n") if line] if path.exists() else []
    except (OSError, ValueError) as error:
        raise corrupt(path, error) from error
