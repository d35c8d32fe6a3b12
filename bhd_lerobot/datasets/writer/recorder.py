"""Frames in, a LeRobotDataset out; every episode is safe when `save` returns."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from bhd_lerobot.datasets.assembly.compact import EpisodeStats, compact
from bhd_lerobot.datasets.assembly.creation import create_root, new_info
from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.episode_table import checked_metadata, metadata_types
from bhd_lerobot.datasets.format.identity import FORMAT, as_json, check_identity, default_root
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import DatasetState, corrupt, slot_of
from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.datasets.recovery.repair import restore_committed
from bhd_lerobot.datasets.recovery.salvage import RepairReport
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, write_errors
from bhd_lerobot.datasets.writer.commit import Committer, EpisodeContent
from bhd_lerobot.datasets.writer.encoder_process import EncoderProcess
from bhd_lerobot.datasets.writer.episode import EpisodeWriter
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError, FrameError

_INTACT = "Episodes saved before are intact."


class DatasetRecorder:
    """Records episodes into a LeRobot v3.0 dataset.

    Make one with `create` or `resume`, and use it as a context manager: leaving the block finalises the dataset, after
    an exception too. Not thread-safe; several episodes may be open at once, and are saved one after the other.

    A save writes everything into a staging folder first, then renames: data, videos, episode metadata, and last
    ``meta/info.json``, whose new episode count makes the episode exist. Unless `fsync` is on, this survives the death
    of the process at any moment, but not a power failure.

    Attributes:
        root: the dataset.
        repo_id: its name on the Hub.
        repair_report: what `resume` had to repair; false if nothing.
    """

    def __init__(
        self,
        repo_id: str,
        state: DatasetState,
        *,
        schema: Schema,
        lock: RootLock,
        disk: Disk,
        video: VideoSettings,
        report: RepairReport,
    ) -> None:
        """Use `create` or `resume` instead."""
        self.repo_id = repo_id
        self.root = state.root
        self.repair_report = report
        self._state, self._schema, self._lock, self._disk, self._video = state, schema, lock, disk, video
        self._committer = Committer(schema, disk, video)
        self._stats: dict[int, EpisodeStats] = {}
        self._before: tuple[dict[str, Any], list[str]] | None = None  # ``info.json`` and tasks before the last save
        self._open: list[EpisodeWriter] = []
        self._begun = 0
        self._encoders: EncoderProcess | None = None
        self._is_uncertain = False
        self._finalized = False

    @classmethod
    def create(
        cls,
        repo_id: str,
        fps: int,
        features: Mapping[str, Mapping[str, Any]],
        *,
        robot_type: str,
        root: Path | str | None = None,
        recording: Mapping[str, Any] | None = None,
        video: VideoSettings | None = None,
        fsync: bool = False,
    ) -> Self:
        """Start a new dataset.

        Args:
            repo_id: name on the Hub, ``user/name``.
            fps: frames per second; time stamps are frame index / fps.
            features: LeRobot feature dictionaries, without LeRobot's default features.
            robot_type: the robot.
            root: where to put it; LeRobot's default place if None. It must not exist.
            recording: identity of the recording, JSON values; `resume` refuses another one.
            video: how to encode cameras.
            fsync: flush every step to the device, so that saved episodes survive a power failure too.

        Raises:
            ConfigError: a feature, frame rate or codec that cannot be recorded.
            DatasetExistsError: `root` exists.
            DatasetWriteError: `root` cannot be written.
        """
        schema, settings = _checked(fps, features, video)
        identity = {"format": FORMAT, "recording": as_json(recording or {}), "video": settings.recorded()}
        root = Path(root) if root is not None else default_root(repo_id)
        disk = Disk(fsync)
        info = new_info(fps, schema, robot_type)
        lock = create_root(root, info, identity, disk)
        state, report = DatasetState(root, info, identity), RepairReport(root, 0, 0)
        return cls(repo_id, state, schema=schema, lock=lock, disk=disk, video=settings, report=report)

    @classmethod
    def resume(
        cls,
        repo_id: str,
        fps: int,
        features: Mapping[str, Mapping[str, Any]],
        *,
        robot_type: str,
        root: Path | str | None = None,
        recording: Mapping[str, Any] | None = None,
        video: VideoSettings | None = None,
        fsync: bool = False,
    ) -> Self:
        """Continue a dataset, after repairing what an interruption left. The arguments are those of `create`.

        `recording` and `video` may be None to accept the recorded ones.

        Raises:
            DatasetMismatchError: another robot, frame rate, feature set or recording; the message shows the difference.
            DatasetCorruptError: a file of a saved episode cannot be read; nothing was changed.
            DatasetLockedError: another process is writing it.
            DatasetError: there is no dataset at `root`.
        """
        schema, settings = _checked(fps, features, video)
        root = Path(root) if root is not None else default_root(repo_id)
        if not root.is_dir():
            raise DatasetError(f"There is no dataset to resume at {root}. Create it first.")
        disk = Disk(fsync)
        lock = RootLock(root, is_choice=True)
        try:
            with write_errors("resume the dataset", root, _INTACT):
                state, report = restore_committed(root, disk)
            _check_last(state)
            check_identity(
                state,
                schema=schema,
                fps=fps,
                robot_type=robot_type,
                recording=recording,
                video=settings.recorded() if video is not None and schema.videos else None,
            )
            if video is None and state.identity is not None:
                settings = VideoSettings(**state.identity["video"])
        except BaseException:
            lock.release()
            raise
        return cls(repo_id, state, schema=schema, lock=lock, disk=disk, video=settings, report=report)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """All features, LeRobot's default ones included."""
        return self._schema.features

    @property
    def fps(self) -> int:
        """Frames per second."""
        return self._state.info["fps"]

    @property
    def num_episodes(self) -> int:
        """Saved episodes."""
        return self._state.num_episodes

    @property
    def num_frames(self) -> int:
        """Frames of all saved episodes."""
        return self._state.num_frames

    def encode_in_process(self) -> None:
        """Encode the videos of coming episodes in a process of their own: `add_image` does not wait any more.

        It takes longer to start than to encode a short episode; for what must not be held up, such as a real robot.
        """
        if self._encoders is None:
            self._encoders = EncoderProcess()

    def begin_episode(self) -> EpisodeWriter:
        """Return a writer for a new episode. Its index is given when it is saved."""
        self._check_not_finalized()
        folder = self.root / layout.STAGING / f"episode-{self._begun}"
        self._begun += 1
        episode = EpisodeWriter(
            self._schema,
            self.fps,
            folder=folder,
            disk=self._disk,
            video=self._video,
            make_encoder=CameraEncoder if self._encoders is None else self._encoders.encoder,
            on_close=self._close_episode,
        )
        self._open.append(episode)
        return episode

    def save(self, episode: EpisodeWriter, *, task: str, metadata: Mapping[str, Any]) -> int:
        """Save an episode. It survives the death of this process as soon as this returns.

        Args:
            episode: from `begin_episode`; it cannot be used afterwards.
            task: the instruction, in natural language.
            metadata: one value per episode, stored in ``meta/episodes`` as ``bhd/<name>``: str, int, float, bool or a
                list of floats. Every episode needs the same names.

        Returns:
            The index of the episode.

        Raises:
            FrameError: the episode or its metadata are not complete; the episode stays open.
            DatasetWriteError: the disk refused it; the episode is lost, the earlier ones are intact.
        """
        self._check_not_finalized()
        if episode not in self._open:
            raise FrameError("This episode is not an open one of this recorder.")
        episode.check_complete()
        if not isinstance(task, str) or not task:
            raise FrameError(f"The task must be a sentence; got {task!r}.")
        self._settle_if_is_uncertain()
        types = self._state.metadata_types if self._state.rows else metadata_types(metadata)
        extra = checked_metadata(metadata, types)
        index = self.num_episodes
        tasks = self._state.tasks if task in self._state.tasks else [*self._state.tasks, task]
        columns = self._with_defaults(episode, tasks.index(task))
        stats = statistics.column_stats({key: columns[key] for key in self._schema.float_keys})
        # From here on an exception may come between any two steps: then the state on the disk counts.
        self._is_uncertain = True
        try:
            with write_errors(f"save episode {index}", self.root, _INTACT):
                videos = episode.finish_videos()
                stats |= {key: statistics.image_stats(histograms) for key, (_, histograms) in videos.items()}
                files = {key: path for key, (path, _) in videos.items()}
                content = EpisodeContent(columns, files, stats, task, tasks, types, extra)
                self._before = dict(self._state.info), list(self._state.tasks)
                self._state = self._committer.commit(self._state, content)
        except BaseException as error:
            self._before = None  # whether there is an episode more, the disk says
            episode.discard()
            if isinstance(error, Exception):
                with contextlib.suppress(OSError):
                    self._settle_if_is_uncertain()
            raise
        self._stats[index] = stats
        self._is_uncertain = False
        episode.close()
        return index

    def drop_last(self) -> None:
        """Take back the last save of this recorder, once: the episode does not exist any more.

        Raises:
            DatasetError: nothing was saved, or the last save was taken back already.
            DatasetWriteError: the disk refused it; where it did so at the end, the episode is gone all the same.
        """
        self._check_not_finalized()
        before, self._before = self._before, None
        if before is None:
            raise DatasetError("There is no episode of this recording that can be taken back.")
        self._settle_if_is_uncertain()
        self._is_uncertain = True
        with write_errors("take back the last episode", self.root, _INTACT):
            self._committer.take_back(self.root, *before)
            # What is not counted any more is dropped as after a kill in the middle of a save.
            self._settle_if_is_uncertain()
        self._stats.pop(self.num_episodes, None)

    def finalize(self) -> None:
        """Discard open episodes, merge the files of this recording, store all statistics, and release the dataset.

        A second call does nothing.

        Raises:
            DatasetWriteError: no space for the merged files. All episodes stay as they are and load; `repair` does
                the rest later.
        """
        if self._finalized:
            return
        for episode in list(self._open):
            episode.discard()
        try:
            consequence = "All saved episodes are intact and load; run `bhd-data repair` when the cause is removed."
            with write_errors("compact the dataset", self.root, consequence):
                self._settle_if_is_uncertain()
                compact(self._state, self._schema, self._disk, self._lock, self._stats)
                self._disk.remove_tree(self.root / layout.STAGING)
            self._finalized = True
        finally:
            self._lock.release()
            if self._encoders is not None:
                self._encoders.close()
                self._encoders = None

    def __enter__(self) -> Self:
        """Return the recorder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Finalise. An error of finalising does not hide the one that ended the block."""
        try:
            self.finalize()
        except BhdError as failure:
            if error is None:
                raise
            error.add_note(f"The dataset could not be finalised either: {failure}")

    def _with_defaults(self, episode: EpisodeWriter, task_index: int) -> dict[str, np.ndarray]:
        frames = np.arange(episode.length)
        return {
            **episode.columns(),
            "timestamp": (frames / self.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(len(frames), self.num_episodes),
            "index": frames + self.num_frames,
            "task_index": np.full(len(frames), task_index),
        }

    def _close_episode(self, episode: EpisodeWriter) -> None:
        if episode in self._open:
            self._open.remove(episode)
        if episode.folder.exists():
            with contextlib.suppress(OSError):
                self._disk.remove_tree(episode.folder)

    def _settle_if_is_uncertain(self) -> None:
        # A failed `finalize` gave the lock back, so that `repair` can be used; it may have been.
        self._is_uncertain |= self._lock.acquire()
        if self._is_uncertain:
            self._state, _ = restore_committed(self.root, self._disk, keep_staging=True)
            self._is_uncertain = False

    def _check_not_finalized(self) -> None:
        if self._finalized:
            raise DatasetError(f"The recording of {self.root} is finalised. Resume the dataset to add episodes.")


def _check_last(state: DatasetState) -> None:
    """Check that the files of the last episode are the last ones: those behind them are the next episode's."""
    for kind in ("data", "meta/episodes", *(f"videos/{key}" for key in state.video_keys)):
        slots = [slot_of(row, kind) for row in state.rows]
        if slots and max(slots) != slots[-1]:
            what = f"the file of episode {slots.index(max(slots))} comes after that of the last episode"
            raise corrupt(state.root / kind, what)


def _checked(
    fps: int, features: Mapping[str, Mapping[str, Any]], video: VideoSettings | None
) -> tuple[Schema, VideoSettings]:
    if not isinstance(fps, int) or isinstance(fps, bool) or fps < 1:
        raise ConfigError(f"fps must be a whole number of at least 1; got {fps!r}.")
    schema, settings = Schema(features), video or VideoSettings()
    for key, feature in schema.features.items():
        names = feature.get("names")
        if feature["dtype"] != "video" and isinstance(names, list | tuple) and len(names) != feature["shape"][0]:
            raise ConfigError(f"Feature {key!r}: {len(names)} names for {feature['shape'][0]} values.")
    if schema.videos:
        settings.check()
    return schema, settings
