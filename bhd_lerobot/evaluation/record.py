"""An evaluation's runs as LeRobotDatasets, one for each brain, written as `bhd-record` writes them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.recording.config import DatasetConfig, RecordConfig
from bhd_lerobot.recording.record import open_recorder, save_episode
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.provenance import episode_metadata
from bhd_lerobot.rollout.types import Episode


class BrainRecorder:
    """Records the episodes of one brain, or nothing if nothing is to be recorded.

    Args:
        recorder: where they go; None for nowhere.
        loop: what runs them.
        split: which set of seeds they are of.
    """

    def __init__(self, recorder: DatasetRecorder | None, loop: EpisodeLoop, split: str) -> None:
        self._recorder, self._loop, self._split = recorder, loop, split

    @classmethod
    @contextmanager
    def open(cls, config: EvalConfig, label: str, loop: EpisodeLoop) -> Iterator[Self]:
        """Open the dataset of a brain; it is complete at the end.

        Raises:
            DatasetError: there is one already, or it cannot be written.
        """
        if config.record.repo_id is None:
            yield cls(None, loop, config.split)
            return
        repo_id = f"{config.record.repo_id}_{label}"
        root = Path(config.record.root).expanduser() / label if config.record.root else default_root(repo_id)
        recording = RecordConfig(
            robot=config.robot,
            dataset=DatasetConfig(repo_id, str(root)),
            brain=config.brains[label],
            task=config.task,
            seed=config.seed,
            split=config.split,
        )
        with open_recorder(recording, root, loop.simulation, loop.task, loop.brain) as recorder:
            yield cls(recorder, loop, config.split)
            recorder.finalize()

    @property
    def begin(self) -> Any:
        """What is called at the start of every episode of a robot with cameras, or None."""
        return None if self._recorder is None else self._recorder.begin_episode

    def save(self, episode: Episode) -> None:
        """Save an episode."""
        if self._recorder is not None:
            task, brain = self._loop.task.parameters(), self._loop.brain.parameters()
            save_episode(self._recorder, episode, episode_metadata(episode, split=self._split, task=task, brain=brain))
