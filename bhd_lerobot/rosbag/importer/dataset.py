"""A dataset that is made of bags: all of it, or nothing."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetWriteError
from bhd_lerobot.rosbag.importer.tracks import TrackOptions
from bhd_lerobot.rosbag.storage.place import complete_or_not


@dataclass
class ImportReport:
    """What was made of bags.

    Attributes:
        root: the dataset.
        episodes, frames: how many.
        problems: what was wrong with the bags, in sentences.
        notes: what was done that somebody should know, in sentences.
    """

    root: Path
    episodes: int = 0
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class RobotImport:
    """What becomes of a bag.

    Attributes:
        robot_type: of the dataset.
        task: the instruction; None if exported bags say it of each episode.
        fps: frames a second.
        observation_names, action_names, environment_names: of the dataset's numbers, in order.
        tracks: how the bag is read.
        max_speed: largest of each action [m/s, rad/s]; what is applied keeps to it. None if that is not known.
        max_age_s: age of the oldest reading beyond which a frame is late.
        max_gap_s: silence of a sensor that ends an episode.
        command_timeout_s: silence after which a command is no longer in force and the robot stands.
        min_episode_s: shorter episodes are left out.
        outcome: what the episodes ended with; None if nobody said.
    """

    robot_type: str
    task: str | None
    fps: int
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    tracks: TrackOptions
    max_speed: tuple[float, ...] | None
    max_age_s: float
    max_gap_s: float
    command_timeout_s: float
    min_episode_s: float
    outcome: str | None = None
    environment_names: tuple[str, ...] = ()

    @property
    def topics(self) -> dict[str, str]:
        """Topics by what they are read for."""
        cameras = {f"camera/{name}": topic for name, topic in self.tracks.cameras.items()}
        return {**self.tracks.topics, **{role: part.topic for role, part in self.tracks.parts.items()}, **cameras}

    def identity(self) -> dict[str, Any]:
        """Return what decides the episodes, JSON values. What a recording says of a simulation is not in it."""
        tracks = self.tracks
        return {
            "imported": {
                "format": "rosbag2",
                "topics": self.topics,
                "stamps": tracks.stamps,
                "scan_frame": tracks.scan_frame,
                "scan_yaw": tracks.scan_yaw,
                "odom_frame": tracks.odom_frame,
                "max_age_s": self.max_age_s,
                "max_gap_s": self.max_gap_s,
                "command_timeout_s": None if np.isinf(self.command_timeout_s) else self.command_timeout_s,
                "min_episode_s": self.min_episode_s,
            }
        }


@contextlib.contextmanager
def all_or_nothing(root: Path) -> Iterator[tuple[Path, Callable[[DatasetRecorder], DatasetRecorder]]]:
    """Give a path at which a dataset is to be made; finalised, it takes its place at the end of the block.

    After an exception, or a kill at any moment, there is no dataset: one with some of the episodes looks like a
    recording that was interrupted, and nobody would know that bags are missing.

    Args:
        root: its place.

    Gives:
        The path, and a function to be told of the recorder once it is created there.

    Raises:
        DatasetExistsError: there is something at `root`.
        DatasetWriteError: it cannot be written.
    """
    recorders: list[DatasetRecorder] = []

    def made(recorder: DatasetRecorder) -> DatasetRecorder:
        recorders.append(recorder)
        return recorder

    with complete_or_not(root, "--root", "import bags", "No dataset was made.") as folder:
        try:
            yield folder, made
            for recorder in recorders:
                recorder.finalize()
        except BaseException as error:
            for recorder in recorders:
                with contextlib.suppress(Exception):
                    recorder.finalize()  # gives the lock back
            if isinstance(error, DatasetWriteError) and isinstance(error.__cause__, OSError):
                raise error.__cause__ from None  # the recorder's remedies are for a dataset that stays
            raise
