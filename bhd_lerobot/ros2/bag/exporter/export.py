"""From a dataset to rosbag2 bags."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from bhd_lerobot.datasets.edit.edits import check_reported, opened
from bhd_lerobot.datasets.format.columns import frames_of, instructions_of, to_numpy
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import DatasetState, Row, ordered_slots
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import refuse_inside
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.exporter.episode import EpisodeTopics, ExportOptions
from bhd_lerobot.ros2.bag.storage.place import complete_or_not
from bhd_lerobot.ros2.bag.storage.write import BagWriter
from bhd_lerobot.ros2.messages import types, views


@dataclass
class ExportReport:
    """What was written: the bags, and how many episodes and messages are in them."""

    bags: list[Path] = field(default_factory=list)
    episodes: int = 0
    messages: int = 0


def export_bags(
    root: Path | str, output: Path | str, *, view: views.RobotView, repo_id: str = "", options: ExportOptions
) -> ExportReport:
    """Write episodes of a dataset as bags; all of them, or nothing, also if the process is killed.

    Args:
        repo_id: name of the dataset; that of its folders if empty.

    Raises:
        DatasetError: no such dataset or episode, or an interrupted edit of it was completed and not reported yet.
        ConfigError: `output` lies in the dataset.
        UnsupportedDatasetError: it holds something that no message is made for.
    """
    root, output = Path(root), Path(output)
    refuse_inside(output, root)
    types.require_rosbags()
    with opened([root]) as (state,):
        if options.episodes is not None:
            check_reported(root)
        return _export(state, output, view, repo_id, options)


def _export(
    state: DatasetState, output: Path, view: views.RobotView, repo_id: str, options: ExportOptions
) -> ExportReport:
    rows = _chosen(state, options.episodes)
    topics = EpisodeTopics(state, view, repo_id or state.root.resolve().name, options)
    report = ExportReport()
    consequence = "The dataset was not touched; no bag was left behind."
    with complete_or_not(output, "--output", "write bags", consequence) as folder:
        if options.one_bag:
            with BagWriter(folder, options.storage, topics.custom) as bag:
                report.messages = sum(bag.write(topics.streams(*episode)) for episode in _episodes(state, rows))
            report.bags.append(output)
        else:
            folder.mkdir()
            for row, columns in _episodes(state, rows):
                name = f"episode_{row['episode_index']:06d}"
                with BagWriter(folder / name, options.storage, topics.custom) as bag:
                    report.messages += bag.write(topics.streams(row, columns))
                report.bags.append(output / name)
        report.episodes = len(rows)
    return report


def _chosen(state: DatasetState, episodes: Sequence[int] | None) -> list[Row]:
    if not state.rows:
        raise DatasetError(f"{state.root} has no episode, so there is nothing to export.")
    if episodes is None:
        return state.rows
    wrong = [index for index in episodes if not 0 <= index < state.num_episodes]
    if wrong or not episodes:
        which = f"There is no episode {wrong[0]} in {state.root}" if wrong else "No episode was requested"
        raise DatasetError(f"{which}; it has {state.num_episodes}, from 0 to {state.num_episodes - 1}.")
    return [state.rows[index] for index in sorted(set(episodes))]


def _episodes(state: DatasetState, chosen: Sequence[Row]) -> Iterator[tuple[Row, dict[str, NDArray[Any]]]]:
    """Yield episodes in order, with their columns; each data file is read once."""
    features = {key: one for key, one in state.info["features"].items() if key not in DEFAULT_FEATURES}
    stored = [key for key, feature in features.items() if feature["dtype"] != "video"]
    files = ordered_slots(state.rows, "data")
    for slot, rows in ordered_slots(chosen, "data").items():
        path = state.root / layout.data_file(slot)
        frames = frames_of(path, files[slot], [*stored, "task_index"])
        for row in rows:
            part = frames[row["episode_index"]]
            tasks = instructions_of(row, part["task_index"].to_numpy(), state.tasks, path)
            yield {**row, "tasks": tasks}, {key: to_numpy(part[key], tuple(features[key]["shape"])) for key in stored}
