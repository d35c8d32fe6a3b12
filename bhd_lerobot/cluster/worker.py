"""The part of a worker that knows this package: it makes what a job asks for, and runs episodes."""

import pickle
import time
import traceback
from contextlib import closing
from typing import Any

from bhd_lerobot.cluster.job import Job, VideoSink, fingerprint, pack, unpacked
from bhd_lerobot.cluster.remote import pack_error
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec


class EpisodeServer:
    """Runs the episodes of one job."""

    def __init__(self, content: bytes) -> None:
        job: Job = pickle.loads(content)
        self._job = job
        self.fingerprint = fingerprint(job.robot, job.task, job.fps)
        self._simulation = make_simulation(job.robot, job.n, job.threads)
        with unpacked(job) as brain_config:
            brain = make_brain(brain_config)
        task = make_task(job.task, job.n, job.fps, self._simulation.body)
        self._loop = EpisodeLoop(self._simulation, task, brain, job.tolerance)
        if self._simulation.camera_names and (job.video is not None or brain.uses_images):
            self._simulation.start_rendering()

    def run(self, specs: list[tuple[int, int]]) -> dict[str, Any]:
        """Run episodes.

        Returns:
            `episodes`: those that were finished, in order, packed; `times`: durations of the brain's calls [s];
            `busy_s`: how long it took [s]; `error` and `traceback`: what ended the run early, if something did.
        """
        started = time.perf_counter()
        episodes: list[bytes] = []
        self._loop.act_times.clear()
        sink = None if self._job.video is None else self._make_sink
        failure: dict[str, Any] = {}
        try:
            with closing(self._loop.run([EpisodeSpec(*spec) for spec in specs], open_images=sink)) as run:
                for episode in run:
                    episodes.append(pack(episode, {} if episode.writer is None else episode.writer.finish()))
        except Exception as error:  # the episodes before it are good
            failure = {"error": pack_error(error), "traceback": traceback.format_exc()}
        times, busy_s = list(self._loop.act_times), time.perf_counter() - started
        return {"episodes": episodes, "times": times, "busy_s": busy_s, **failure}

    def _make_sink(self) -> VideoSink:
        job = self._job
        if job.video is None:
            raise AssertionError("Images of this job are not recorded.")
        return VideoSink(job.fps, (job.robot.camera_height, job.robot.camera_width), job.video)
