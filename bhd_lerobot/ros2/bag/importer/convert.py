"""From bags to a dataset with the columns that our own recordings of the robot have: all of it, or nothing."""

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetWriteError
from bhd_lerobot.ros2.bag.importer.columns import (
    MOST_UNEXPLAINED,
    command_note,
    frame_columns,
    unanswered,
    unexplained_frames,
)
from bhd_lerobot.ros2.bag.importer.exported import Exported, StatedEpisode, exported
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.resample import NANO, ROUNDING_NS, Grid, grids, newest
from bhd_lerobot.ros2.bag.importer.segments import segments, silence_notes
from bhd_lerobot.ros2.bag.importer.tracks import Track, read_tracks, seconds
from bhd_lerobot.ros2.bag.importer.video import CameraImages
from bhd_lerobot.ros2.bag.storage.place import complete_or_not
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages.table import TWIST
from bhd_lerobot.tasks.task import Event

_LISTED = 8  # sentences in an error; a damaged bag may give hundreds


@dataclass
class ImportReport:
    """What was made of bags."""

    root: Path
    episodes: int = 0
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def import_bags(bags: Sequence[Bag], root: Path, repo_id: str, options: ImportOptions) -> ImportReport:
    """Make a dataset of bags of a robot; the whole of it, or nothing, also after a kill.

    Raises:
        DatasetError: a bag does not have what is needed.
    """
    report = ImportReport(root)
    names = options.observation_names
    if {*TWIST} <= {*options.action_names} and not {*TWIST} & {*names}:
        report.notes.append(
            f"no odometry is read: the state is {names[0]} to {names[-1]}, without {' and '.join(TWIST)}. Whether the "
            "robot obeyed is not known, and a policy that learns from it needs a robot that observes the same"
        )
    # A dataset with some of the episodes would look like a recording that was interrupted.
    with (
        complete_or_not(report.root, "--root", "import bags", "No dataset was made.") as folder,
        _recording(folder, repo_id, options) as recording,
    ):
        for bag in bags:
            stated = exported(bag)
            _check_stated(bag, stated, options)
            robot_bag = _RobotBag(bag, options, recording, stated)
            episodes = list(robot_bag.episodes())
            robot_bag.check_commands(episodes)
            for episode in episodes:
                report.frames += robot_bag.save(episode)
                report.episodes += 1
            report.problems += bag.problems
            report.notes += [f"{bag.path.name}: {note}" for note in robot_bag.notes]
        if not report.episodes:
            sensors = ", ".join(source.topic for source in options.sources if not source.is_action)
            reasons = "; ".join([*report.problems, *report.notes][:_LISTED])
            raise DatasetError(
                f"No episode of {options.min_episode_s:g} s or more came out of {', '.join(str(b.path) for b in bags)}:"
                f" there is no such time in which {sensors} were received at least every {options.max_gap_s:g} s. "
                f"{reasons}"
            )
    if late := recording.late:
        most, bag_name = max(late)
        report.notes.append(
            f"{sum(count for count, _ in late)} of {report.frames} frames, in {len(late)} of {report.episodes} "
            f"episodes, have a reading older than {options.max_age_s:g} s; control.late is true in them (the most in "
            f"one of {bag_name}: {most})"
        )
    return report


def _check_stated(bag: Bag, stated: Exported | None, options: ImportOptions) -> None:
    """Check that the instruction is known, and that robot and rate are the dataset's."""
    if not options.task and (stated is None or not all(one.task for one in stated.episodes)):
        raise ConfigError(f"{bag.path} states no instruction. Describe the robot's task: --task='Drive around.'")
    if stated is None:
        return
    is_other = options.robot_is_stated and stated.robot_type != options.robot_type
    if is_other or (options.as_stated and stated.fps != options.fps):
        raise DatasetError(
            f"The dataset is of {options.robot_type!r} at {options.fps} fps, and {bag.path} of {stated.robot_type!r} "
            f"at {stated.fps} fps. Import the bags one by one; --fps sets one rate for all."
        )


@contextlib.contextmanager
def _recording(folder: Path, repo_id: str, options: ImportOptions) -> Iterator["_Recording"]:
    """Give the dataset that is being made, and finalise it at the end of the block."""
    recording = _Recording(folder, repo_id, options)
    try:
        yield recording
        recording.finalize()
    except BaseException as error:
        with contextlib.suppress(Exception):
            recording.finalize()  # releases the lock
        if isinstance(error, DatasetWriteError) and isinstance(error.__cause__, OSError):
            raise error.__cause__ from None  # the recorder's remedies are for a dataset that stays
        raise


class _Recording:
    """The dataset that is being made.

    Attributes:
        late: of each episode that has any, how many frames are late, and the name of its bag.
    """

    def __init__(self, folder: Path, repo_id: str, options: ImportOptions) -> None:
        self.late: list[tuple[int, str]] = []
        self._folder, self._repo_id, self._options = folder, repo_id, options
        self._recorder: DatasetRecorder | None = None
        self._has_outcomes: bool | None = None
        self._seen: dict[tuple[int, ...], Path] = {}

    def finalize(self) -> None:
        if self._recorder is not None:
            self._recorder.finalize()

    def recorder(self, cameras: Sequence[CameraImages]) -> DatasetRecorder:
        """Return the recorder, which is created with the first episode."""
        if self._recorder is None:
            options = self._options
            images = {camera.key.removeprefix(f"{keys.OBSERVATION_IMAGES}."): camera.shape() for camera in cameras}
            # The state of a real robot's physics is not known.
            features = keys.dataset_features(options.observation_names, options.action_names, images, {})
            self._recorder = DatasetRecorder.create(
                self._repo_id,
                options.fps,
                features,
                robot_type=options.robot_type,
                root=self._folder,
                recording=options.identity(),
            )
        return self._recorder

    def refuse_mixed(self, bag: Path, outcome: str | None) -> None:
        """Refuse a bag that states outcomes where others do not, or the other way round."""
        if self._has_outcomes is None:
            self._has_outcomes = outcome is not None
        if self._has_outcomes != (outcome is not None):
            raise DatasetError(
                f"{bag} states {'no outcomes' if outcome is None else 'outcomes'} of its episodes, unlike the bags "
                "before it. Give one for all with --outcome, or import it by itself."
            )

    def refuse_again(self, bag: Path, start: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Refuse a drive that is in another bag, too: one that was copied, or converted to another storage."""
        numbers = (start, *(crc32(columns[key].tobytes()) for key in (keys.OBSERVATION_STATE, keys.ACTION)))
        if numbers in self._seen:
            raise DatasetError(
                f"{self._seen[numbers]} and {bag} hold the same drive: the same numbers at {start / NANO:.3f} s. It "
                "would be in the dataset twice; leave one of them out."
            )
        self._seen[numbers] = bag


@dataclass(frozen=True)
class _Episode:
    """Frames, and the tracks of the segment of the bag in which they lie, sorted by time.

    Attributes:
        stated: what the bag states of it; None of bags that were not exported.
    """

    grid: Grid
    tracks: Sequence[Track]
    stated: StatedEpisode | None


class _RobotBag:
    """One bag, all of it but images in memory."""

    def __init__(self, bag: Bag, options: ImportOptions, recording: _Recording, stated: Exported | None) -> None:
        self.notes: list[str] = []
        self._bag, self._options, self._recording, self._stated = bag, options, recording, stated
        self._tracks = read_tracks(bag, options, {} if stated is None else stated.messages, self.notes)
        is_whole = stated is not None and not bag.problems and all(len(one.times) for one in stated.episodes)
        self._is_as_stated = options.as_stated and is_whole
        self._cameras = [CameraImages(bag, track, self.notes) for track in self._tracks if not track.names]
        self._begin = min(int(track.times.min()) for track in self._tracks)
        self._check_clocks()

    def _check_clocks(self) -> None:
        """Check that commands and sensors are of one time."""
        sensors = [track.times for track in self._tracks if not track.is_action]
        begin, end = min(int(sensor.min()) for sensor in sensors), max(int(sensor.max()) for sensor in sensors)
        for track in self._tracks:
            cmd = track.times
            if track.is_action and (int(cmd.max()) < begin - NANO or int(cmd.min()) > end + NANO):
                raise DatasetError(
                    f"{self._bag.path}: {track.topic} is from {cmd.min() / NANO:.1f} to {cmd.max() / NANO:.1f} s and "
                    f"the sensors are from {begin / NANO:.1f} to {end / NANO:.1f} s, so no command belongs to them. "
                    "Their stamps are of different clocks; --stamps=receive takes the recorder's for all."
                )

    def episodes(self) -> Iterator[_Episode]:
        """Yield the episodes in order."""
        for found in self._found():
            if (grid := self._answered(found.grid, found.tracks)) is None:
                continue
            lasts = (len(grid.times) - 1) / self._options.fps
            if lasts >= self._options.min_episode_s:
                yield replace(found, grid=grid)
            else:
                self.notes.append(
                    f"a segment of {lasts:.2f} s, {self._after_start(grid)}, is shorter than --min_episode_s and "
                    "was left out"
                )

    def _found(self) -> Iterator[_Episode]:
        """Yield the episodes that a bag states, or that its sensors allow."""
        options, stated = self._options, () if self._stated is None else self._stated.episodes
        if self._is_as_stated:
            ordered = [track.part(np.ones(len(track.times), np.bool_)) for track in self._tracks]
            for one in stated:
                # Of its own messages: those that are left out are not replaced by another episode's in the same bag.
                span = one.times[0] - ROUNDING_NS, one.times[-1] + ROUNDING_NS + 1
                tracks = [track.rows(np.arange(*np.searchsorted(track.times, span))) for track in ordered]
                readings = [track.times for track in tracks if not track.is_action]
                if not all(map(len, readings)):
                    self.notes.append(f"an episode of {len(one.times)} frames has no readings, and is left out")
                    continue
                rows = np.stack([newest(times, one.times) for times in readings])
                ages = one.times - np.stack([times[row] for times, row in zip(readings, rows, strict=True)])
                blind = int((rows < 0).any(axis=0).sum())
                yield _Episode(Grid(one.times, ages, "start").since(blind), tracks, one)
            return
        parts = segments(
            self._tracks,
            stamps=options.stamps,
            max_speed=options.max_speed if options.pose else None,
            max_gap_s=options.max_gap_s,
            notes=self.notes,
        )
        begin = 0
        for part in parts:
            # The pose began anew, not the clock: a command from before is still in force.
            begin = begin if part.why == "reset" else part.first
            of_commands = part._replace(first=begin)
            tracks = [track.part((of_commands if track.is_action else part).mask(track)) for track in self._tracks]
            sensors = [track for track in tracks if not track.is_action]
            self.notes += silence_notes(sensors, self._begin, round(options.max_gap_s * NANO))
            for grid in grids(
                [track.times for track in sensors],
                options.fps,
                max_age_ns=round(options.max_age_s * NANO),
                max_gap_ns=round(options.max_gap_s * NANO),
                why=part.why,
            ):
                last, by_header = int(grid.times[-1]), options.stamps == "header"
                yield _Episode(grid, tracks, self._stated.at(last, by_header=by_header) if self._stated else None)

    def _answered(self, grid: Grid, tracks: Sequence[Track]) -> Grid | None:
        """Return frames from the first on that has a command, of actions that are positions; None if none has."""
        blind, n = unanswered(self._options, tracks, grid.times), len(grid.times)
        if blind:
            self.notes.append(
                f"{self._after_start(grid)}: the first {blind} of {n} frames come before the first command, and are "
                "left out: without one the robot is somewhere, not at the position 0"
            )
        return grid.since(blind) if blind < n else None

    def check_commands(self, episodes: Sequence[_Episode]) -> None:
        """Check that commands explain how the robot moves, unless the user said how long they are in force."""
        options, n = self._options, sum(len(episode.grid.times) for episode in episodes)
        counts = {
            timeout: np.sum(
                [unexplained_frames(options, one.tracks, one.grid.times, timeout) for one in episodes], axis=0
            )
            for timeout in options.timeouts
            if n
        }
        if not counts or (moving := counts[options.command_timeout_s][0]) <= MOST_UNEXPLAINED * n:
            return
        actions = [source for source in options.sources if source.is_action]
        topics = " and ".join(source.topic for source in actions)
        what = {
            timeout: "the last command" if math.isinf(timeout) else "none, after so many seconds" for timeout in counts
        }
        choices = "; ".join(
            f"--command_timeout={timeout:g}, {what[timeout]}: the robot moves in {blind} frames with the action 0, and "
            f"stands in {against} although the action says to drive"
            for timeout, (blind, against) in counts.items()
        )
        raise DatasetError(
            f"{self._bag.path}: the robot moves in {moving} of {n} frames ({100 * moving / n:.0f} %) without a command "
            f"of {topics} that is in force, so their action would be 0. Name the topic that drove "
            f"it with {actions[0].option}, or choose what is in force while no command comes. {choices}."
        )

    def save(self, episode: _Episode) -> int:
        """Save an episode and return its number of frames."""
        recorder, options = self._recording.recorder(self._cameras), self._options
        episode = self._with_images(episode)
        if (stated := episode.stated) is not None:
            options = replace(options, task=options.task or stated.task, outcome=options.outcome or stated.outcome)
        times, ages = episode.grid.times, episode.grid.ages.max(axis=0)
        writer = recorder.begin_episode()
        try:
            for camera in self._cameras:
                shown = camera.write(camera.of(episode.tracks), times, writer)
                ages = np.maximum(ages, times - shown)
            columns = frame_columns(options, episode.tracks, times, ages)
            is_as_recorded = self._is_as_stated and stated is not None and len(times) == len(stated.times)
            if stated is not None and is_as_recorded:
                own = set() if options.robot_is_stated else {keys.APPLIED_ACTION}  # in the units of another mapping
                own |= {keys.SUCCESS, keys.EVENT} if self._options.outcome else set()
                columns |= {key: values for key, values in stated.columns.items() if key not in own}
            self._recording.refuse_mixed(self._bag.path, options.outcome)
            self._recording.refuse_again(self._bag.path, int(times[0]), columns)
            writer.set_columns(columns)
            recorder.save(writer, task=options.task, metadata=self._metadata(episode, columns, options.outcome))
        except BaseException:
            writer.discard()
            raise
        begin = self._after_start(episode.grid)
        if is_as_recorded:
            return len(times)
        if silence := command_note(options, columns):
            self.notes.append(f"{begin}: {silence}")
        if late := int(columns[keys.LATE].sum()):
            self._recording.late.append((late, self._bag.path.name))
        return len(times)

    def _with_images(self, episode: _Episode) -> _Episode:
        """Return an episode from the frame on at which every camera has an image that can be decoded."""
        grid = episode.grid
        blind = max((camera.blind(camera.of(episode.tracks), grid.times) for camera in self._cameras), default=0)
        if blind:
            self.notes.append(
                f"{self._after_start(grid)}: the episode begins {blind} frames later, with the first image that can "
                "be decoded"
            )
        return replace(episode, grid=grid.since(blind))

    def _metadata(self, episode: _Episode, columns: Mapping[str, NDArray[Any]], outcome: str | None) -> dict[str, Any]:
        """Return how an episode ended, if that is known, and where it is from."""
        ended = {} if outcome is None else {"outcome": outcome, "success": outcome == Event.SUCCESS.cause}
        source = {
            "bag": self._bag.path.name,
            "start_ns": int(episode.grid.times[0]),
            "why": episode.grid.why,
            "late_frames": int(columns[keys.LATE].sum()),
            "problems": self._bag.problems,
        }
        return {**ended, "source": json.dumps(source)}

    def _after_start(self, grid: Grid) -> str:
        return f"{seconds(int(grid.times[0]) - self._begin)} after the start"
