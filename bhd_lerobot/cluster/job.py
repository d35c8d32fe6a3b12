"""What a worker of a cluster needs to know, and what it gives back: everything travels, nothing is on a shared disk."""

import dataclasses
import hashlib
import os
import pickle
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.baselines import RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint
from bhd_lerobot.policies.perception.perceiver import PerceptionOptions
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.tolerance import TimingTolerance
from bhd_lerobot.rollout.types import Episode, EpisodeSpec

_PROBE_FRAMES = 20


@dataclass(frozen=True)
class Job:
    """Episodes of one robot, one task and one brain.

    `checkpoints`: files of the trained policies in `brain`, by the path that it names, then by file name.
    """

    robot: Any
    task: Any
    brain: Any
    tolerance: TimingTolerance
    fps: int
    n: int
    threads: int
    video: VideoSettings | None = None
    checkpoints: dict[str, dict[str, bytes]] = field(default_factory=dict)


@dataclass(frozen=True)
class Video:
    """The encoded images of one camera in one episode, with their histograms, (frames, 3, 256), uint32, compressed."""

    content: bytes
    frames: int
    histograms: bytes


def read_checkpoints(brain: Any) -> dict[str, dict[str, bytes]]:
    """Return the files of the trained policies that a brain's configuration names."""
    found: dict[str, dict[str, bytes]] = {}
    for config in _learned(brain):
        folder = find_checkpoint(config.path)
        try:
            files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
            found[config.path] = {str(path.relative_to(folder)): path.read_bytes() for path in files}
        except OSError as error:
            raise ConfigError(f"The policy {config.path!r} cannot be sent to the cluster: {error}.") from error
    return found


@contextmanager
def unpacked(job: Job) -> Iterator[Any]:
    """Give the brain's configuration with its policies in a temporary folder; loaded, they need it no more.

    Afterwards the configuration names the policies as it did before, in messages too.
    """
    if not job.checkpoints:
        yield job.brain
        return
    with TemporaryDirectory(prefix="bhd-policy-") as name:
        brain = pickle.loads(pickle.dumps(job.brain))
        policies = [(config, config.path) for config in _learned(brain)]
        for number, (config, path) in enumerate(policies):
            folder = Path(name) / str(number)
            for file, content in job.checkpoints[path].items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(content)
            config.path = str(folder)
        yield brain
        for config, path in policies:
            config.path = path


def _learned(config: Any) -> Iterator[LearnedBrainConfig | PerceptionOptions]:
    """Yield the trained policies in a brain's configuration, which may hold other brains."""
    if isinstance(config, LearnedBrainConfig | PerceptionOptions):
        if config.path:
            yield config
    elif dataclasses.is_dataclass(config):
        for one in dataclasses.fields(config):
            yield from _learned(getattr(config, one.name))


class VideoSink:
    """Takes the images of one episode and encodes them into memory: a worker that is killed leaves no file behind."""

    def __init__(self, fps: int, size: tuple[int, int], settings: VideoSettings) -> None:
        self._make = partial(_encoder, fps, size, settings)
        self._encoders: dict[str, tuple[int, CameraEncoder]] = {}

    def add_image(self, key: str, image: NDArray[np.uint8]) -> None:
        """Queue one image of a camera."""
        if key not in self._encoders:
            self._encoders[key] = self._make(key)
        self._encoders[key][1].add(image)

    def finish(self) -> dict[str, Video]:
        """Return the videos by camera."""
        videos = {}
        for key, (file, encoder) in self._encoders.items():
            histograms = encoder.finish()
            content = os.pread(file, os.fstat(file).st_size, 0)
            packed = zlib.compress(np.ascontiguousarray(histograms, np.uint32).tobytes(), 1)
            videos[key] = Video(content, encoder.frames, packed)
            os.close(file)
        self._encoders = {}
        return videos

    def discard(self) -> None:
        """Drop everything."""
        for file, encoder in self._encoders.values():
            encoder.cancel()
            os.close(file)
        self._encoders = {}


def _encoder(fps: int, size: tuple[int, int], settings: VideoSettings, key: str) -> tuple[int, CameraEncoder]:
    file = os.memfd_create(f"{key}.mp4")
    return file, CameraEncoder(Path(f"/proc/self/fd/{file}"), fps, size, settings)


def histograms_of(video: Video) -> NDArray[np.uint32]:
    """Return the histograms of a video's images, shape (frames, 3, 256)."""
    flat = np.frombuffer(zlib.decompress(video.histograms), np.uint32)
    return flat.reshape(video.frames, 3, 256)


def pack(episode: Episode, videos: dict[str, Video]) -> bytes:
    """Return an episode as bytes. Its writer stays where it is."""
    return pickle.dumps((dataclasses.replace(episode, writer=None), videos), pickle.HIGHEST_PROTOCOL)


def unpack(content: bytes) -> tuple[Episode, dict[str, Video]]:
    """Return what `pack` was given."""
    episode, videos = pickle.loads(content)
    return episode, videos


class _Listener(RandomBrain):
    """Moves at random, and digests what it sees."""

    def __init__(self) -> None:
        super().__init__(RandomConfig())
        self.digest = hashlib.sha256()
        self.frames = 0

    def act(self, observation: Observation) -> NDArray[np.float64]:
        self.frames += 1
        action = super().act(observation)
        self.digest.update(np.ascontiguousarray(observation.state).tobytes() + np.ascontiguousarray(action).tobytes())
        return action


def fingerprint(robot: Any, task: Any, fps: int) -> str:
    """Return a digest of what this machine computes for the beginning of one fixed episode.

    Equal versions are not enough: another processor may take other instructions for the same sine.
    """
    joints = {"control": "servo", "action_space": "joint"} if hasattr(robot, "action_space") else {}  # with ranges
    simulation = make_simulation(dataclasses.replace(robot, camera=False, **joints), 1)
    brain = _Listener()
    loop = EpisodeLoop(simulation, make_task(task, 1, fps, simulation.body), brain)
    for _ in loop.run([EpisodeSpec(0, 0)], lambda: brain.frames >= _PROBE_FRAMES):
        pass
    simulation.close()
    return brain.digest.hexdigest()


class EpisodeServer:
    """Runs the episodes of one job in a worker."""

    def __init__(self, content: bytes) -> None:
        self._job = job = pickle.loads(content)
        self.fingerprint = fingerprint(job.robot, job.task, job.fps)
        simulation = make_simulation(job.robot, job.n, job.threads)
        with unpacked(job) as brain_config:
            brain = make_brain(brain_config)
        task = make_task(job.task, job.n, job.fps, simulation.body)
        self._loop = EpisodeLoop(simulation, task, brain, job.tolerance)
        if simulation.camera_names and (job.video is not None or brain.uses_images):
            simulation.start_rendering()

    def run(self, specs: list[tuple[int, int]]) -> dict[str, Any]:
        """Run episodes; return those that were finished, packed, the brain's times [s], and the error that ended it."""
        answer: dict[str, Any] = {"episodes": [], "times": self._loop.act_times}
        self._loop.act_times.clear()
        sink = None if self._job.video is None else self._make_sink
        try:
            with closing(self._loop.run([EpisodeSpec(*spec) for spec in specs], open_images=sink)) as run:
                for episode in run:
                    videos = {} if episode.writer is None else episode.writer.finish()
                    answer["episodes"].append(pack(episode, videos))
        except Exception as error:  # the episodes before it are good
            answer["error"] = error
        return answer

    def _make_sink(self) -> VideoSink:
        job = self._job
        return VideoSink(job.fps, (job.robot.camera_height, job.robot.camera_width), job.video)
