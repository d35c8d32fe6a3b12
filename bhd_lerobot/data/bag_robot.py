"""From the bag of a real robot on wheels to episodes with the columns that our recordings of that robot have."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.data import features as keys
from bhd_lerobot.data.bag_dataset import ImportReport, RobotImport, all_or_nothing
from bhd_lerobot.data.bag_images import decode_image
from bhd_lerobot.data.bag_read import Bag, Picker
from bhd_lerobot.data.bag_tracks import Track, read_tracks, seconds
from bhd_lerobot.data.identity import default_root
from bhd_lerobot.data.recorder import DatasetRecorder
from bhd_lerobot.data.resample import CLOCK_STEP_NS, NANO, STEP_BACK_NS, Grid, clock_jumps, grids, newest
from bhd_lerobot.data.ros2_base import GYRO, ODOMETRY, TWIST
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.tasks.task import Event


def import_robot(bags: Sequence[Bag], root: Path | str | None, repo_id: str, wanted: RobotImport) -> ImportReport:
    """Make a dataset of bags of a robot; the whole of it, or nothing.

    Args:
        bags: in order; each gives one episode, or several where it has gaps.
        root: where to put it; LeRobot's default place if None.
        repo_id: its name.
        wanted: what becomes of them.

    Raises:
        DatasetError: a bag does not have what is needed.
        DatasetExistsError: `root` exists.
    """
    report = ImportReport(Path(root) if root is not None else default_root(repo_id))
    recorder: DatasetRecorder | None = None
    with all_or_nothing(report.root) as made:
        for bag in bags:
            robot_bag = _RobotBag(bag, wanted)
            for episode in robot_bag.episodes():
                if recorder is None:
                    features = _features(wanted, robot_bag.image_shapes())
                    recorder = made(
                        DatasetRecorder.create(
                            repo_id,
                            wanted.fps,
                            features,
                            robot_type=wanted.robot_type,
                            root=report.root,
                            recording=wanted.identity(),
                        )
                    )
                report.frames += robot_bag.save(episode, recorder)
                report.episodes += 1
            report.problems += bag.problems
            report.notes += [f"{bag.path.name}: {note}" for note in robot_bag.notes]
        if recorder is None:
            sensors = ", ".join(topic for role, topic in wanted.topics.items() if role != "cmd")
            told = "; ".join([*report.notes, *report.problems])
            raise DatasetError(
                f"No episode of {wanted.min_episode_s:g} s or more came out of {', '.join(str(b.path) for b in bags)}: "
                f"there is no such time in which {sensors} were heard at least every {wanted.max_gap_s:g} s. {told}"
            )
    return report


def _features(wanted: RobotImport, images: Mapping[str, tuple[int, int, int]]) -> dict[str, dict[str, Any]]:
    features = keys.dataset_features(wanted.observation_names, wanted.action_names, images, ("none",))
    del features[keys.PHYSICS_STATE]  # nobody knows it of a real robot
    return features


@dataclass(frozen=True)
class _Episode:
    """Frames, and the tracks of the stretch of the bag in which they lie, sorted by time."""

    grid: Grid
    tracks: Mapping[str, Track]


class _RobotBag:
    """One bag, all of it but pictures in memory."""

    def __init__(self, bag: Bag, wanted: RobotImport) -> None:
        self.notes: list[str] = []
        self._bag, self._wanted = bag, wanted
        self._tracks = read_tracks(bag, wanted.tracks, self.notes)
        self._pictures = {role: Picker(bag, one.topic) for role, one in self._tracks.items() if _is_camera(role)}
        self._begin = min(int(track.times.min()) for track in self._tracks.values())
        self._check_clocks()

    def _check_clocks(self) -> None:
        """Check that commands and sensors are of one time.

        Raises:
            DatasetError: they are not: a bare Twist has the recorder's time, and headers may have a simulation's.
        """
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
        """Yield the episodes in order."""
        wanted = self._wanted
        every = list(self._tracks.values())
        step = CLOCK_STEP_NS if wanted.tracks.stamps == "receive" else STEP_BACK_NS
        jumps = clock_jumps([track.times for track in every], [track.order for track in every], step)
        bounds = [0, *jumps.tolist(), np.iinfo(np.int64).max]
        if len(jumps):
            self.notes.append(f"the clock jumped back {len(jumps)} times; each time a new episode begins")
        for number, (first, end) in enumerate(pairwise(bounds)):
            tracks = {
                role: track.part((track.order >= first) & (track.order < end)) for role, track in self._tracks.items()
            }
            sensors = {role: track for role, track in tracks.items() if role != "cmd"}
            self._tell_gaps(sensors)
            for grid in grids(
                [track.times for track in sensors.values()],
                wanted.fps,
                max_age_ns=round(wanted.max_age_s * NANO),
                max_gap_ns=round(wanted.max_gap_s * NANO),
                why="clock" if number else "start",
            ):
                lasts = (len(grid.times) - 1) / wanted.fps
                if lasts >= wanted.min_episode_s:
                    yield _Episode(grid, tracks)
                else:
                    self.notes.append(
                        f"a stretch of {lasts:.2f} s, {seconds(int(grid.times[0]) - self._begin)} after the start, is "
                        "shorter than --min_episode_s and was left out"
                    )

    def _tell_gaps(self, sensors: Mapping[str, Track]) -> None:
        limit = round(self._wanted.max_gap_s * NANO)
        for track in sensors.values():
            steps = np.diff(track.times)
            for place in np.flatnonzero(steps > limit)[:5].tolist():
                after = seconds(int(track.times[place]) - self._begin)
                self.notes.append(
                    f"{track.topic} was silent for {seconds(int(steps[place]))} ({after} after the start), or the "
                    "clock jumped ahead; a new episode begins"
                )

    def image_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Return the shapes of the cameras' pictures by name."""
        return {
            role.removeprefix("camera/"): self._picture(role, 0).shape  # type: ignore[misc]
            for role in self._pictures
        }

    def save(self, episode: _Episode, recorder: DatasetRecorder) -> int:
        """Save an episode and return its number of frames."""
        columns = self._columns(episode)
        times = episode.grid.times
        writer = recorder.begin_episode()
        try:
            writer.set_columns(columns)
            for role in self._pictures:
                track = episode.tracks[role]
                for place in track.values[newest(track.times, times), 0].astype(np.intp).tolist():
                    key = f"{keys.OBSERVATION_IMAGES}.{role.removeprefix('camera/')}"
                    writer.add_image(key, self._picture(role, place))
            recorder.save(writer, task=self._wanted.task, metadata=self._metadata(episode, columns))
        except BaseException:
            writer.discard()
            raise
        self._tell_silence(columns, int(times[0]))
        late = int(columns[keys.LATE].sum())
        if late:
            self.notes.append(
                f"{late} of {len(times)} frames of the episode {seconds(int(times[0]) - self._begin)} after the start "
                f"have a reading older than {self._wanted.max_age_s:g} s; control.late is true in them"
            )
        return len(times)

    # --- what is in a frame ------------------------------------------------------------------------------------------

    def _columns(self, episode: _Episode) -> dict[str, NDArray[Any]]:
        wanted, times = self._wanted, episode.grid.times
        n = len(times)
        age = episode.grid.ages.max(axis=0)
        asked, command_age = self._commands(episode.tracks["cmd"], times)
        heard = command_age >= 0
        applied = np.clip(asked, -np.array(wanted.max_speed), wanted.max_speed)
        over = (applied != asked).any(axis=1)
        done = np.arange(n) == n - 1
        ended = Event.NOTHING if wanted.outcome is None else Event[wanted.outcome.upper()]
        return {
            keys.OBSERVATION_STATE: self._state(episode),
            keys.ACTION: asked.astype(np.float32),
            keys.APPLIED_ACTION: applied.astype(np.float32),
            keys.TIME: (times - times[0]) / NANO,
            keys.AGE: (age / NANO).astype(np.float32),
            keys.COMMAND_AGE: (np.where(heard, command_age, 0) / NANO).astype(np.float32),
            keys.LATENESS: np.zeros(n, np.float32),
            keys.OVERRUNS: np.zeros(n, np.int64),
            keys.SKIPPED: np.zeros(n, np.int64),
            keys.INFERENCE_TIME: np.zeros(n, np.float32),
            keys.LATE: age > round(wanted.max_age_s * NANO),
            keys.LIMITS: np.where(over, int(Limit.VELOCITY), 0),
            keys.WATCHDOG: np.where(heard, 0, int(Watchdog.COMMAND_AGE)),
            keys.MODE: np.where(heard, int(Mode.TRACKING), int(Mode.HOLD)),
            keys.REWARD: np.zeros(n, np.float32),
            keys.SUCCESS: done & (ended == Event.SUCCESS),
            keys.DONE: done,
            keys.EVENT: np.where(done, int(ended), 0),
        }

    def _commands(self, track: Track, times: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the command in force at the end of each frame, shape (n, 2), and its age then [ns]; 0 and -1 if none.

        An action is what was asked for over the frame that an observation begins. What answers the observation comes
        after it: the command in force when the observation was taken is the answer to the one before.
        """
        ends = times + round(NANO / self._wanted.fps)
        place = np.searchsorted(track.times, ends, side="left") - 1
        known = np.maximum(place, 0)
        if not len(track.times):
            return np.zeros((len(times), len(TWIST))), np.full(len(times), -1, np.int64)
        age = np.where(place < 0, -1, ends - track.times[known])
        timeout = self._wanted.command_timeout_s
        if np.isfinite(timeout):
            age = np.where(age > round(timeout * NANO), -1, age)
        order = [TWIST.index(name) for name in self._wanted.action_names]
        return np.where(age[:, None] >= 0, track.values[known], 0.0)[:, order], age

    def _tell_silence(self, columns: Mapping[str, NDArray[Any]], begin: int) -> None:
        """Tell how many frames have no command, and whether the robot drove in them."""
        silent = columns[keys.MODE] == int(Mode.HOLD)
        if not silent.any():
            return
        names = list(self._wanted.observation_names)
        speeds = columns[keys.OBSERVATION_STATE][:, [names.index(name) for name in TWIST]]
        moving = int((silent & (np.abs(speeds) > _MOVES).any(axis=1)).sum())
        drove = (
            f", though the robot moved in {moving} of them: --command_timeout=inf is for robots that go on with the "
            "last command"
            if moving
            else ""
        )
        self.notes.append(
            f"{int(silent.sum())} of {len(silent)} frames of the episode {seconds(begin - self._begin)} after the "
            f"start have no command that is younger than {self._wanted.command_timeout_s:g} s; their action is 0{drove}"
        )

    def _state(self, episode: _Episode) -> NDArray[np.float32]:
        times, tracks = episode.grid.times, episode.tracks

        def at(role: str) -> NDArray[np.float64]:
            return tracks[role].values[newest(tracks[role].times, times)]

        scan, odom = at("scan"), at("odom")
        columns = dict(zip(TWIST, odom[:, :2].T, strict=True))
        columns |= dict(zip(ODOMETRY, _since_start(odom[:, 2:]).T, strict=True))
        columns |= {f"scan_{beam:03d}.pos": scan[:, beam] for beam in range(scan.shape[1])}
        if "imu" in tracks:
            columns |= dict(zip(GYRO, at("imu").T, strict=True))
        return np.stack([columns[name] for name in self._wanted.observation_names], axis=1).astype(np.float32)

    def _metadata(self, episode: _Episode, columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        outcome = self._wanted.outcome
        source = {
            "bag": self._bag.path.name,
            "start_ns": int(episode.grid.times[0]),
            "why": episode.grid.why,
            "late_frames": int(columns[keys.LATE].sum()),
            "problems": self._bag.problems,
        }
        told = {} if outcome is None else {"outcome": outcome, "success": outcome == Event.SUCCESS.cause}
        return {"source": json.dumps(source), **told}

    def _picture(self, role: str, place: int) -> NDArray[np.uint8]:
        track = self._tracks[role]
        return decode_image(track.topic, track.msgtype, self._pictures[role].get(place))


_MOVES = 0.01
"""[m/s, rad/s] A robot that is slower stands."""


def _is_camera(role: str) -> bool:
    return role.startswith("camera/")


def _since_start(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses x, y, yaw in the frame of the first one, shape (n, 3)."""
    x, y, yaw = (pose - pose[0]).T
    cos, sin = np.cos(pose[0, 2]), np.sin(pose[0, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, yaw], axis=1)
