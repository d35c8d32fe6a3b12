"""An episode loop whose episodes are run by the workers of a cluster."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from rich.console import Console

from bhd_lerobot.cluster.cluster import connected
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.job import Job, fingerprint, histograms_of, read_checkpoints, unpack
from bhd_lerobot.cluster.pool import CONTINUE, WorkerPool
from bhd_lerobot.cluster.pool import Task as ClusterTask
from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.errors import ClusterError
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.tolerance import TimingTolerance
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Task


@contextmanager
def open_pool(config: RayConfig, console: Console) -> Iterator[WorkerPool]:
    """Join a cluster, or start one, and give those who will work there."""
    with connected(config), WorkerPool(config, console) as pool:
        yield pool


class ClusterLoop(EpisodeLoop):
    """Runs episodes on the workers of a cluster and yields the same, in the same order, as an `EpisodeLoop`.

    Robots, task and brain are made here, too: they say what is recorded, and what does not fit fails before a dataset
    exists.
    """

    def __init__(
        self,
        robots: Robots,
        task: Task,
        brain: Brain,
        tolerance: TimingTolerance | None = None,
        *,
        pool: WorkerPool,
        config: Any,
        brain_config: Any,
    ) -> None:
        super().__init__(robots, task, brain, tolerance)
        self._pool, self._config, self._brain_config = pool, config, brain_config

    def run(
        self,
        specs: Sequence[EpisodeSpec],
        stop: Callable[[], bool] = lambda: False,
        open_images: Callable[[], Any] | None = None,
    ) -> Generator[Episode]:
        """Run episodes and yield them in their order, each as soon as it and all before it are done.

        Raises:
            ClusterError: the cluster cannot continue, or the emergency stop was pressed.
            Exception: what the brain, the task or the simulation raised in a worker.
        """
        if not specs:
            return
        per_task = self._per_task(len(specs))
        pairs = [(spec.index, spec.seed) for spec in specs]
        parts = [pairs[first : first + per_task] for first in range(0, len(pairs), per_task)]
        tasks = [ClusterTask(number, part) for number, part in enumerate(parts)]
        video = None
        if open_images is not None and self.robots.camera_shapes:
            writer = open_images()
            video = writer.video
            writer.discard()
        job = self._job(min(self._config.n_envs, per_task), video)
        ours = fingerprint(job.robot, job.task, job.fps)
        for result in self._pool.run(job, ours, tasks, lambda: stop() or self._is_estopped()):
            self.act_times.extend(result["times"])
            for content in result["episodes"]:
                episode, videos = unpack(content)
                if open_images is not None and videos:
                    writer = open_images()
                    try:
                        for key, one in videos.items():
                            writer.add_video(key, one.content, histograms_of(one))
                    except BaseException:
                        writer.discard()
                        raise
                    episode = replace(episode, writer=writer)
                self.frames += episode.frames
                yield episode

    def _per_task(self, episodes: int) -> int:
        """Return how many episodes a worker gets at a time."""
        wanted, n = self._config.ray.episodes_per_task, self._config.n_envs
        if wanted is not None:
            return int(wanted)
        # Twice as many as run side by side: one that is over early makes room for another. Two turns for each worker.
        fair = -(-episodes // (2 * self._pool.workers_for(episodes)))
        return 1 if n == 1 else max(1, min(2 * n, fair))

    def _job(self, n: int, video: VideoSettings | None) -> Job:
        config = self._config
        return Job(
            robot=config.robot,
            task=config.task,
            brain=self._brain_config,
            tolerance=self.tolerance,
            fps=self.robots.rates.fps,
            n=n,
            threads=config.threads or config.ray.cpus_per_worker,
            video=video,
            checkpoints=read_checkpoints(self._brain_config),
        )

    def _is_estopped(self) -> bool:
        if self.robots.estop_pressed:
            raise ClusterError(f"Emergency stop. Episodes that were running on the cluster were dropped. {CONTINUE}")
        return False
