"""One brain's part of an evaluation: its episodes, and what results and report need of them."""

import heapq
import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.cluster.loop import ClusterLoop
from bhd_lerobot.cluster.pool import WorkerPool
from bhd_lerobot.datasets.format.columns import read_episodes
from bhd_lerobot.datasets.format.features import PHYSICS_STATE
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.summary import EpisodeSummary, dataset_info
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import BhdError, DatasetMismatchError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.metrics import EpisodeMetrics, JerkMeasure, measure
from bhd_lerobot.policies.brain import is_privileged
from bhd_lerobot.registry import make_brain, make_task
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.rollout.episode import EpisodeLoop, track_of
from bhd_lerobot.rollout.plots import Trajectory
from bhd_lerobot.rollout.provenance import episode_metadata, recorded_episode, versions
from bhd_lerobot.rollout.recorder import Recording, open_recorder, save_episode
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.operator import judged
from bhd_lerobot.tasks.task import episode_seed

VIDEOS = 2  # failures of each brain of which videos are made, by default


@dataclass
class BrainRun:
    """What a brain's run leaves; of what videos are to be made: episode, scene and recorded physics states."""

    label: str
    loop: EpisodeLoop
    episodes: list[EpisodeMetrics] = field(default_factory=list)
    trajectories: dict[int, Trajectory] = field(default_factory=dict)
    videos: list[tuple[EpisodeMetrics, Any, NDArray[np.float64]]] = field(default_factory=list)
    initial_states: list[NDArray[np.float64]] = field(default_factory=list)
    recorder: DatasetRecorder | None = None
    recorded: Mapping[int, EpisodeSummary] = field(default_factory=dict)
    wall_s: float = 0.0

    @property
    def is_privileged(self) -> bool:
        """Whether the brain acts on what no sensor measures."""
        return is_privileged(self.loop.brain, self.loop.task.environment_names)

    def close(self) -> None:
        """Close the brain."""
        self.loop.brain.close()

    def timing(self) -> dict[str, Any]:
        """Return what was measured on the wall clock, as plain values."""
        calls = np.array(self.loop.act_times)
        ran = [episode for episode in self.episodes if episode.episode not in self.recorded]
        simulated = sum(episode.length_s for episode in ran)
        quantiles = dict(zip(("p50_s", "p99_s", "max_s"), np.quantile(calls, (0.5, 0.99, 1.0)).tolist(), strict=True))
        per = self.wall_s if self.wall_s > 0 else np.inf
        return {
            "wall_s": self.wall_s,
            "episodes_per_s": len(ran) / per,
            "real_time_factor": simulated / per,
            "act": {"calls": len(calls), "robots_per_call": self.loop.robots.n, **quantiles},
            "episodes": {str(episode.episode): episode.wall for episode in self.episodes if episode.wall},
        }


def prepare(config: EvalConfig, label: str, robots: Robots, pool: WorkerPool | None = None) -> BrainRun:
    """Make a brain and what runs it: one that does not fit fails here, before any episode."""
    fps = robots.rates.fps
    try:
        brain = make_brain(config.brains[label])
        task = make_task(config.task, robots.n, fps, robots.body)
        task = judged(task, robots.knows, robots.n, fps)
        if pool is None:
            return BrainRun(label, EpisodeLoop(robots, task, brain))
        loop = ClusterLoop(robots, task, brain, pool=pool, config=config, brain_config=config.brains[label])
        return BrainRun(label, loop)
    except BhdError as error:
        raise type(error)(f"brains.{label}: {error}") from error


def jerk_of(robots: Robots) -> JerkMeasure:
    """Return what jerk is measured of; the units of a robot of another package are not known."""
    return JerkMeasure.of(robots.action_names, is_si=robots.body is not None)


def specs_of(config: EvalConfig) -> list[EpisodeSpec]:
    """Return the episodes of each brain."""
    split: Any = config.split
    return [EpisodeSpec(index, episode_seed(config.seed, index, split)) for index in config.indices]


@contextmanager
def open_dataset(config: EvalConfig, one: BrainRun) -> Iterator[None]:
    """Open the dataset of a brain, if one is wanted, and find which episodes it holds already."""
    with _recorder(config, one.label, one.loop) as one.recorder:
        one.recorded = _rows_of(one.recorder, specs_of(config)) if one.recorder else {}
        yield


def run_episodes(
    config: EvalConfig, one: BrainRun, specs: Sequence[EpisodeSpec], stop: Callable[[], bool], show: Callable[[], None]
) -> None:
    """Run some of a brain's episodes and store what results and report need of them."""
    robots, loop, recorder = one.loop.robots, one.loop, one.recorder
    jerk, fps = jerk_of(robots), robots.rates.fps
    rows = [one.recorded[spec.index] for spec in specs if spec.index in one.recorded]
    missing = [spec for spec in specs if spec.index not in one.recorded]
    before, started = one.wall_s, time.perf_counter()
    run = loop.run(missing, stop, recorder.begin_episode if recorder else None)
    known = _recorded_episodes(recorder, rows) if recorder else iter(())
    for episode in heapq.merge(known, run, key=lambda episode: episode.spec.index):
        track = track_of(robots, episode.columns)
        metrics = measure(one.label, episode, track, jerk, fps)
        if recorder and metrics.episode not in one.recorded:
            task, brain = loop.task.parameters(), loop.brain.parameters()
            save_episode(recorder, episode, episode_metadata(episode, split=config.split, task=task, brain=brain))
        one.episodes.append(metrics)
        one.initial_states.append(episode.initial_state)
        _store(config, one, metrics, episode, track)
        one.wall_s = before + time.perf_counter() - started
        show()


def _rows_of(recorder: DatasetRecorder, specs: Sequence[EpisodeSpec]) -> dict[int, EpisodeSummary]:
    """Return which of the episodes a dataset holds, by their numbers, in ascending order."""
    seeds = {spec.index: str(spec.seed) for spec in specs}
    rows = {int(row.metadata["episode"]): row for row in dataset_info(recorder.root).episodes}
    wanted = {number: row for number, row in sorted(rows.items()) if seeds.get(number) == row.metadata["seed"]}
    for row in wanted.values():
        then, now = json.loads(row.metadata["versions"]), versions()
        if changed := [f"{name} {then.get(name)}, now {now[name]}" for name in now if then.get(name) != now[name]]:
            raise DatasetMismatchError(
                f"The episodes in {recorder.root} were recorded with {'; '.join(changed)}: the missing episodes would "
                "not be comparable. Set another --record.root, or use the versions of the recording."
            )
    return wanted


def _recorded_episodes(recorder: DatasetRecorder, rows: Collection[EpisodeSummary]) -> Iterator[Episode]:
    columns = read_episodes(recorder.root, [row.index for row in rows])
    for row, values in zip(rows, columns, strict=True):
        yield recorded_episode(row.metadata, values, row.task)


@contextmanager
def _recorder(config: EvalConfig, label: str, loop: EpisodeLoop) -> Iterator[DatasetRecorder | None]:
    """Open the dataset of a brain, if one is wanted, as `bhd-record` writes it; one that was begun is continued."""
    if config.record.repo_id is None:
        yield None
        return
    repo_id = f"{config.record.repo_id}_{label}"
    root = Path(config.record.root).expanduser() / label if config.record.root else default_root(repo_id)
    recording = Recording(repo_id, root, loop.robots.rates.fps, config.task, config.seed, config.split, resume=True)
    with open_recorder(recording, loop.robots, loop.task, loop.brain) as recorder:
        yield recorder
        recorder.finalize()


def _store(
    config: EvalConfig, one: BrainRun, metrics: EpisodeMetrics, episode: Episode, track: NDArray[np.float64]
) -> None:
    if len(track):
        title = f"{metrics.episode}: {metrics.outcome}, {metrics.score:.2f}"
        one.trajectories[metrics.episode] = Trajectory(
            title, episode.scene, track[:, :2].astype(np.float32), metrics.success, episode.instruction
        )
    failures = sum(not other.success for other in one.episodes)
    wanted = VIDEOS if config.videos is None else config.videos
    if not metrics.success and failures == 1:
        one.videos.clear()  # the first episode, for the case that none fails
    if PHYSICS_STATE not in episode.columns:
        return
    if (not metrics.success and failures <= wanted) or (len(one.episodes) == 1 and wanted):
        one.videos.append((metrics, episode.scene, episode.columns[PHYSICS_STATE]))
