"""What is in a dataset, without loading its frames."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.errors import DatasetError, DatasetLockedError


@dataclass(frozen=True)
class EpisodeSummary:
    """One episode.

    Attributes:
        index: its index.
        frames: its length.
        task: the instruction.
        metadata: what the recorder stored about it, for example outcome, seed and timing; empty for datasets that
            another program recorded.
    """

    index: int
    frames: int
    task: str
    metadata: dict[str, Any]


@dataclass(frozen=True)
class DatasetSummary:
    """A dataset.

    Attributes:
        root: where it lies.
        robot_type: the robot, if recorded.
        fps: frames per second.
        features: LeRobot feature dictionaries.
        tasks: all instructions.
        frames: frames of all episodes.
        episodes: one entry per episode.
        recording: identity of the recording; empty for datasets that another program recorded.
        files: data, video and episode-metadata files.
        size: their bytes.
        compact: whether the recording was finalised: files merged and statistics stored.
    """

    root: Path
    robot_type: str | None
    fps: int
    features: dict[str, dict[str, Any]]
    tasks: tuple[str, ...]
    frames: int
    episodes: tuple[EpisodeSummary, ...]
    recording: dict[str, Any]
    files: int
    size: int
    compact: bool


def dataset_info(root: Path | str) -> DatasetSummary:
    """Return what is in the dataset at `root`; nothing is changed.

    Raises:
        DatasetError: there is no dataset.
        DatasetCorruptError: a file cannot be read.
    """
    root = Path(root)
    state = load_state(root)
    files = state.files()
    episodes = tuple(
        EpisodeSummary(
            index=row["episode_index"],
            frames=row["length"],
            task=", ".join(row["tasks"]),
            metadata={
                # Of a mixture, an episode may lack what others have.
                key.removeprefix(PREFIX): value
                for key, value in row.items()
                if key.startswith(PREFIX) and value is not None
            },
        )
        for row in state.rows
    )
    return DatasetSummary(
        root=root,
        robot_type=state.info.get("robot_type"),
        fps=state.info["fps"],
        features=state.info["features"],
        tasks=tuple(state.tasks[: state.info["total_tasks"]]),
        frames=state.num_frames,
        episodes=episodes,
        recording=(state.identity or {}).get("recording", {}),
        files=len(files),
        size=sum((root / name).stat().st_size for name in files),
        compact=not state.without_stats,
    )


def is_being_written(root: Path) -> bool:
    """Return whether a dataset is being recorded, repaired or edited by us at this moment."""
    try:
        RootLock(root, is_shared=True).release()
    except DatasetLockedError:
        return True
    except OSError:  # it is missing or may not be read
        return False
    return False


def check_not_empty(summary: DatasetSummary) -> None:
    """Check that there is an episode."""
    if not summary.episodes:
        raise DatasetError(f"{summary.root} is empty: it has no episodes.")
