"""From bags to episodes with the columns that our own recordings of the robot have."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.importer.breaks import segments, silence_notes
from bhd_lerobot.rosbag.importer.columns import command_note, frame_columns
from bhd_lerobot.rosbag.importer.dataset import ImportReport, RobotImport, all_or_nothing
from bhd_lerobot.rosbag.importer.exported import ExportedEpisode
from bhd_lerobot.rosbag.importer.resample import NANO, Grid, grids
from bhd_lerobot.rosbag.importer.tracks import Track, read_tracks, seconds
from bhd_lerobot.rosbag.importer.video import CAMERA, CameraImages
from bhd_lerobot.rosbag.storage.read import Bag
from bhd_lerobot.tasks.task import Event

_LISTED = 8  # sentences in an error; a damaged bag may give hundreds


def import_bags(
    bags: Sequence[Bag],
    root: Path | str | None,
    repo_id: str,
    wanted: RobotImport,
    exported: Sequence[Sequence[ExportedEpisode]] = (),
) -> ImportReport:
    """Make a dataset of bags of a robot, or of exported ones; the whole of it, or nothing.

    Args:
        bags: in order; each gives one episode, or several where it has gaps.
        root: where to put it; LeRobot's default place if None.
        repo_id: its name.
        wanted: what becomes of them.
        exported: what each bag says of its episodes, if `bhd-data export` wrote it.

    Raises:
        DatasetError: a bag does not have what is needed.
        DatasetExistsError: `root` exists.
    """
    report = ImportReport(Path(root) if root is not None else default_root(repo_id))
    recorder: DatasetRecorder | None = None
    seen: dict[tuple[int, ...], Path] = {}
    late: list[tuple[int, str]] = []
    with all_or_nothing(report.root) as (folder, made):
        for place, bag in enumerate(bags):
            robot_bag = _RobotBag(bag, wanted, seen, exported[place] if exported else ())
            for episode in robot_bag.episodes():
                if recorder is None:
                    features = _features(wanted, robot_bag.image_shapes())
                    recorder = made(
                        DatasetRecorder.create(
                            repo_id,
                            wanted.fps,
                            features,
                            robot_type=wanted.robot_type,
                            root=folder,
                            recording=wanted.identity(),
                        )
                    )
                report.frames += robot_bag.save(episode, recorder)
                report.episodes += 1
            report.problems += bag.problems
            report.notes += [f"{bag.path.name}: {note}" for note in robot_bag.notes]
            late += [(count, bag.path.name) for count in robot_bag.late if count]
        if recorder is None:
            sensors = ", ".join(topic for role, topic in wanted.topics.items() if role != "cmd")
            told = "; ".join([*report.problems, *report.notes][:_LISTED])
            raise DatasetError(
                f"No episode of {wanted.min_episode_s:g} s or more came out of {', '.join(str(b.path) for b in bags)}: "
                f"there is no such time in which {sensors} were heard at least every {wanted.max_gap_s:g} s. {told}"
            )
    if late:
        most, bag_name = max(late)
        total = sum(count for count, _ in late)
        report.notes.append(
            f"{total} of {report.frames} frames, in {len(late)} of {report.episodes} episodes, "
            f"have a reading older than {wanted.max_age_s:g} s; control.late is true in them (the most in one of "
            f"{bag_name}: {most})"
        )
    return report


def _features(wanted: RobotImport, images: Mapping[str, tuple[int, int, int]]) -> dict[str, dict[str, Any]]:
    features = keys.dataset_features(
        wanted.observation_names, wanted.action_names, images, (), wanted.environment_names
    )  # nobody knows the state of a real robot's physics
    return {key: feature for key, feature in features.items() if feature["shape"] != (0,)}


@dataclass(frozen=True)
class _Episode:
    """Frames, and the tracks of the segment of the bag in which they lie, sorted by time.

    Attributes:
        exported: what the bag says of it, if `bhd-data export` wrote the bag.
    """

    grid: Grid
    tracks: Mapping[str, Track]
    exported: ExportedEpisode | None


class _RobotBag:
    """One bag, all of it but images in memory."""

    def __init__(
        self,
        bag: Bag,
        wanted: RobotImport,
        seen: dict[tuple[int, ...], Path],
        exported: Sequence[ExportedEpisode],
    ) -> None:
        self.notes: list[str] = []
        self.late: list[int] = []  # frames of each episode that was saved
        self._seen = seen
        self._bag, self._wanted = bag, wanted
        self._exported = exported
        self._tracks = read_tracks(bag, wanted.tracks, self.notes)
        self._cameras = [
            CameraImages(bag, role, track, self.notes)
            for role, track in self._tracks.items()
            if role.startswith(CAMERA)
        ]
        self._begin = min(int(track.times.min()) for track in self._tracks.values())
        self._check_clocks()

    def _check_clocks(self) -> None:
        """Check that commands and sensors are of one time.

        Raises:
            DatasetError: they are not: a bare Twist has the recorder's time, and headers may have a simulation's.
        """
        if "cmd" not in self._tracks:
            return
        cmd = self._tracks["cmd"].times
        sensors = [track.times for role, track in self._tracks.items() if role != "cmd"]
        begin, end = min(int(one.min()) for one in sensors), max(int(one.max()) for one in sensors)
        if int(cmd.max()) < begin - NANO or int(cmd.min()) > end + NANO:
            raise DatasetError(
                f"{self._bag.path}: {self._tracks['cmd'].topic} is from {cmd.min() / NANO:.1f} to "
                f"{cmd.max() / NANO:.1f} s and the sensors are from {begin / NANO:.1f} to {end / NANO:.1f} s, so no "
                "command belongs to them. Their stamps are of different clocks; --stamps=receive takes the recorder's "
                "for all."
            )

    def episodes(self) -> Iterator[_Episode]:
        """Yield the episodes in order.

        Raises:
            DatasetError: the pose that is to be observed jumps all the time.
        """
        wanted = self._wanted
        parts = segments(
            self._tracks,
            [one.place for one in self._exported],
            stamps=wanted.tracks.stamps,
            max_speed=wanted.max_speed if "odom" in self._tracks and wanted.tracks.pose else None,
            max_gap_s=wanted.max_gap_s,
            notes=self.notes,
        )
        begin = 0
        for part in parts:
            # The pose began anew, not the clock: a command from before is still in force.
            begin = begin if part.why == "reset" else part.first
            begun = [one for one in self._exported if one.place <= part.first] or self._exported[:1]
            of_commands = part._replace(first=begin)
            tracks = {
                role: track.part((of_commands if role == "cmd" else part).mask(track))
                for role, track in self._tracks.items()
            }
            sensors = {role: track for role, track in tracks.items() if role != "cmd"}
            self.notes += silence_notes(sensors, self._begin, round(wanted.max_gap_s * NANO))
            for grid in grids(
                [track.times for track in sensors.values()],
                wanted.fps,
                max_age_ns=round(wanted.max_age_s * NANO),
                max_gap_ns=round(wanted.max_gap_s * NANO),
                why=part.why,
            ):
                lasts = (len(grid.times) - 1) / wanted.fps
                if lasts >= wanted.min_episode_s:
                    yield _Episode(grid, tracks, begun[-1] if begun else None)
                else:
                    self.notes.append(
                        f"a segment of {lasts:.2f} s, {self._after_start(grid)}, is shorter than --min_episode_s and "
                        "was left out"
                    )

    def image_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Return the shapes of the cameras' images by name."""
        return {camera.name: camera.shape() for camera in self._cameras}

    def save(self, episode: _Episode, recorder: DatasetRecorder) -> int:
        """Save an episode and return its number of frames.

        Raises:
            DatasetError: its images cannot be decoded, or it was saved before.
        """
        episode = self._with_images(episode)
        times, ages = episode.grid.times, episode.grid.ages.max(axis=0)
        writer = recorder.begin_episode()
        try:
            for camera in self._cameras:
                shown = camera.write(episode.tracks[camera.role], times, writer)
                ages = np.maximum(ages, times - shown)
            task, metadata = self._described(episode)
            columns = frame_columns(self._wanted, episode.tracks, times, ages, metadata.get("outcome"))
            self._refuse_again(int(times[0]), columns)
            writer.set_columns(columns)
            recorder.save(writer, task=task, metadata={**metadata, "source": self._source(episode, columns)})
        except BaseException:
            writer.discard()
            raise
        begin = self._after_start(episode.grid)
        if silence := command_note(self._wanted, columns):
            self.notes.append(f"{begin}: {silence}")
        self.late.append(int(columns[keys.LATE].sum()))
        return len(times)

    def _with_images(self, episode: _Episode) -> _Episode:
        """Return an episode from the frame on at which every camera has an image that can be decoded."""
        grid = episode.grid
        blind = max((camera.blind(episode.tracks[camera.role], grid.times) for camera in self._cameras), default=0)
        if blind:
            self.notes.append(
                f"{self._after_start(grid)}: the episode begins {blind} frames later, with the first image that can "
                "be decoded"
            )
        return replace(episode, grid=Grid(grid.times[blind:], grid.ages[:, blind:], grid.why))

    def _refuse_again(self, start: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Refuse a drive that is in another bag, too: one that was copied, or converted to another storage.

        Raises:
            DatasetError: it is. No two drives have the same numbers at the same nanosecond.
        """
        vectors = (columns[key] for key in (keys.OBSERVATION_STATE, keys.ACTION) if key in columns)
        numbers = (start, *(crc32(values.tobytes()) for values in vectors))
        if numbers in self._seen:
            raise DatasetError(
                f"{self._seen[numbers]} and {self._bag.path} hold the same drive: the same numbers at "
                f"{start / NANO:.3f} s. It would be in the dataset twice; leave one of them out."
            )
        self._seen[numbers] = self._bag.path

    def _described(self, episode: _Episode) -> tuple[str, dict[str, Any]]:
        """Return the task of an episode, and what is known of it: what the user says, or else the bag."""
        wanted, exported = self._wanted, episode.exported
        said = {} if wanted.outcome is None else {
            "outcome": wanted.outcome, "success": wanted.outcome == Event.SUCCESS.cause
        }  # fmt: skip
        if exported is None:
            assert wanted.task is not None
            return wanted.task, said
        metadata = {**exported.metadata}
        end = exported.start[wanted.tracks.stamps == "header"] + exported.duration
        if int(episode.grid.times[-1]) + 2 * NANO // wanted.fps < end and metadata.get("outcome"):
            self.notes.append(
                f"{self._after_start(episode.grid)}: the episode ends before the one that was exported, so that its "
                f"outcome, {metadata['outcome']}, is left out"
            )
            metadata |= {"outcome": ""} | ({"success": False} if "success" in metadata else {})
        return wanted.task or exported.task, metadata | said

    def _source(self, episode: _Episode, columns: Mapping[str, NDArray[Any]]) -> str:
        """Return where an episode is from, JSON."""
        source = {
            "bag": self._bag.path.name,
            "start_ns": int(episode.grid.times[0]),
            "why": episode.grid.why,
            "late_frames": int(columns[keys.LATE].sum()),
            "problems": self._bag.problems,
        }
        return json.dumps(source)

    def _after_start(self, grid: Grid) -> str:
        return f"{seconds(int(grid.times[0]) - self._begin)} after the start"
