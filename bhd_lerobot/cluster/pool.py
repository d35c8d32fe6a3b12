"""The workers of a cluster: started, given episodes, and replaced when they are lost."""

import contextlib
import heapq
import pickle
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cluster import remote as cluster_remote
from bhd_lerobot.cluster.cluster import describe_crowding, describe_machines, free_places, size_of
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.job import Job
from bhd_lerobot.cluster.task import Call, Task, Worker, cause_of, error_of
from bhd_lerobot.errors import ClusterError

CONTINUE = "What was recorded is saved; the same command runs the rest, bhd-record with --resume=true."
_QUEUED = 2  # tasks that a worker has at a time: it continues with the next while a result travels
_WINDOW = 4  # tasks for each worker, finished or not, by which the run may be ahead of the oldest that is missing
_DEATHS = 3  # of workers, with the same task in hand
_STARTS = 5  # of workers that are lost before they are ready, in a row
_POLL_S = 0.2
_PRINTED = 200  # lines of workers in a run

_DISTRIBUTIONS = ("ray", "lerobot_robot_bhd", "lerobot", "mujoco", "numpy", "scipy", "pin", "ruckig")


class WorkerPool:
    """Runs tasks on workers and gives their results in order. Use it as a context manager.

    Attributes:
        busy_s: time that workers spent on episodes [s], of all of them together.

    Args:
        config: how many workers, and of what size.
        console: where losses, and what workers print, are printed.
        server: module of the workers' `EpisodeServer`.
    """

    def __init__(self, config: RayConfig, console: Console, server: str = "bhd_lerobot.cluster.worker") -> None:
        self._config, self._console, self._server = config, console, server
        self._workers: list[Worker] = []
        self._calls: dict[Any, Call] = {}
        self._lost_early = 0
        self._has_described_crowding = False
        self._failed: tuple[int, BaseException] | None = None  # from this task on there are no results, and why
        self._printed: Counter[str] = Counter()
        self._facts: dict[str, str] = {}
        self._distributions: tuple[str, ...] = ()
        self.busy_s = 0.0

    def run(self, job: Job, fingerprint: str, tasks: Sequence[Task], stop: Callable[[], bool]) -> Iterator[Any]:
        """Yield the results of tasks, in their order; ends early when `stop` returns true.

        Args:
            job: what the tasks are of.
            fingerprint: what this machine computes for it; workers that compute something else are refused.
            tasks: the tasks.
            stop: called a few times a second.

        Raises:
            ClusterError: no worker could be started, or they are lost again and again.
            Exception: what a worker raised, once everything before it was yielded.
        """
        import ray

        self._job = ray.put(pickle.dumps(job, pickle.HIGHEST_PROTOCOL))
        self._fingerprint = fingerprint
        extra = ("torch", "safetensors") if job.has_policy else ()
        self._distributions = (*_DISTRIBUTIONS, *extra, *(("av",) if job.video is not None else ()))
        self._facts = cluster_remote.facts_of_machine(self._distributions)
        self._waiting = list(tasks)
        heapq.heapify(self._waiting)
        self._done: dict[int, Any] = {}
        self._failed = None
        self._wanted = self.workers_for(len(tasks))
        crowding = "" if self._has_described_crowding else describe_crowding(self._config, self._wanted)
        if crowding:
            self._console.print(escape(crowding), soft_wrap=True, highlight=False)
            self._has_described_crowding = True
        self._idle_since = time.monotonic()
        self._dismiss(lambda worker: bool(worker.tasks))  # what a run before left undone is not wanted any more
        for worker in self._workers:
            worker.job = None
            self._call(worker, "describe", worker.actor.describe.remote(self._distributions))
        numbers = [task.number for task in sorted(tasks)]
        for place, number in enumerate(numbers):
            limit = numbers[min(place + _WINDOW * self._wanted, len(numbers)) - 1]
            while number not in self._done:
                self._raise_failure(number)
                if stop():
                    return
                self._step(limit)
            self._raise_failure(number)  # others may have run what comes after it
            yield self._done.pop(number)
        self._raise_failure(numbers[-1] + 1)

    def workers_for(self, tasks: int) -> int:
        """Return how many workers some tasks will have.

        Raises:
            ClusterError: no machine has room for one.
        """
        places = free_places(self._config)
        if not places:
            raise ClusterError(
                f"No machine of the cluster has {size_of(self._config)} for a worker. There is: {describe_machines()}. "
                "Lower --ray.cpus_per_worker or --ray.gpus_per_worker, or add a machine."
            )
        return max(1, min(self._config.num_workers or places, tasks))

    def __enter__(self) -> "WorkerPool":
        """Return the pool itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all workers, in whatever they are doing."""
        self._dismiss(lambda worker: True)

    def _dismiss(self, which: Callable[[Worker], bool]) -> None:
        """End some workers, and forget all calls."""
        import ray

        self._calls.clear()
        for worker in filter(which, list(self._workers)):
            self._workers.remove(worker)
            with contextlib.suppress(ray.exceptions.RayError):
                ray.kill(worker.actor)

    def _raise_failure(self, number: int) -> None:
        """Raise what a worker raised, if it was before this task."""
        if self._failed is not None and number >= self._failed[0]:
            raise self._failed[1]

    def _step(self, limit: int) -> None:
        """Keep all workers busy with tasks up to a number, and take in what was answered."""
        import ray

        while len(self._workers) < self._wanted:
            self._start()
        for worker in self._workers:
            self._hand_out(worker, limit)
        answered, _ = ray.wait(list(self._calls), num_returns=1, timeout=_POLL_S)
        for reference in answered:
            call = self._calls.pop(reference, None)
            if call is None:
                continue  # of a worker that was given up in this very round
            try:
                answer = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise ClusterError(f"A worker on {call.worker.host} failed: {error}") from error
            except ray.exceptions.RayError as error:
                self._lost(call.worker, error)
                continue
            self._take(call, answer)
        self._check_idle()

    def _start(self) -> None:
        import ray

        ray.cloudpickle.register_pickle_by_value(cluster_remote)
        try:
            remote = ray.remote(cluster_remote.RemoteWorker).options(
                num_cpus=self._config.cpus_per_worker,
                num_gpus=self._config.gpus_per_worker,
                max_restarts=0,
                scheduling_strategy="SPREAD",
            )
            worker = Worker(remote.remote())
            self._workers.append(worker)
            self._call(worker, "describe", worker.actor.describe.remote(self._distributions))
        finally:
            ray.cloudpickle.unregister_pickle_by_value(cluster_remote)

    def _call(self, worker: Worker, kind: str, reference: Any, task: Task | None = None) -> None:
        self._calls[reference] = Call(worker, kind, task)

    def _hand_out(self, worker: Worker, limit: int) -> None:
        last = limit if self._failed is None else min(limit, self._failed[0] - 1)
        while worker.is_ready and len(worker.tasks) < _QUEUED and self._waiting and self._waiting[0].number <= last:
            if worker.tasks and (self._waiting[0].is_suspect or worker.tasks[0].is_suspect):
                return
            task = heapq.heappop(self._waiting)
            worker.tasks.append(task)
            self._call(worker, "run", worker.actor.run.remote(task.specs), task)

    def _take(self, call: Call, answer: dict[str, Any]) -> None:
        worker = call.worker
        if call.kind == "describe":
            worker.host, worker.is_there = f"{answer['host']}, process {answer['pid']}", True
            self._check_facts(worker, answer["facts"])
            self._call(worker, "prepare", worker.actor.prepare.remote(self._job, self._server))
            return
        self._print(worker, answer["printed"])
        if call.kind == "prepare":
            if "error" in answer:
                raise error_of(answer, f"A worker on {worker.host} could not start.")
            self._check_fingerprint(worker, answer["value"])
            worker.job, self._lost_early = self._job, 0
            return
        task = call.task
        if task is None:
            raise AssertionError("Only tasks are run.")
        worker.tasks.remove(task)
        value = {"episodes": [], "times": [], "busy_s": 0.0, **answer.get("value", {})}
        failure = answer if "error" in answer else value
        self._done[task.number] = value
        self.busy_s += value["busy_s"]
        if "error" in failure and (self._failed is None or task.number < self._failed[0]):
            # What comes before it is still run: as on one machine, it is in the dataset.
            self._failed = (task.number + 1, error_of(failure, f"It came up in {task} on {worker.host}."))

    def _lost(self, worker: Worker, error: BaseException) -> None:
        """Give a worker up and its tasks to others."""
        import ray

        self._workers.remove(worker)
        self._calls = {reference: call for reference, call in self._calls.items() if call.worker is not worker}
        ray.kill(worker.actor)  # if it lives after all, nobody listens to it any more
        cause = cause_of(error)
        if not worker.is_ready:
            self._lost_early += 1
            if self._lost_early >= _STARTS:
                raise ClusterError(
                    f"{self._lost_early} workers in a row were lost before they were ready, the last on {worker.host}: "
                    f"{cause} Ray's logs are on that machine, in /tmp/ray/session_latest/logs."
                ) from error
        for task in worker.tasks:
            task.is_suspect = True
        if len(worker.tasks) == 1:
            worker.tasks[0].deaths += 1
            if worker.tasks[0].deaths >= _DEATHS:
                raise ClusterError(
                    f"{_DEATHS} workers were lost while they ran {worker.tasks[0]}, the last on {worker.host}: {cause} "
                    "Perhaps it needs more memory than they have: lower --n_envs or --ray.episodes_per_task. Ray's "
                    f"logs are on that machine, in /tmp/ray/session_latest/logs. {CONTINUE}"
                ) from error
        for task in worker.tasks:
            heapq.heappush(self._waiting, task)
        again = f"; {', '.join(map(str, worker.tasks))} will be run again" if worker.tasks else ""
        self._console.print(f"A worker was lost ({escape(worker.host)}){again}: {escape(cause)}", highlight=False)
        self._idle_since = time.monotonic()

    def _check_idle(self) -> None:
        """Raise if no worker has been there for too long."""
        now = time.monotonic()
        if any(worker.is_there for worker in self._workers):
            self._idle_since = now
        elif now - self._idle_since > self._config.timeout_s:
            raise ClusterError(
                f"No worker could be started within {self._config.timeout_s:g} s (ray.timeout_s): each asks for "
                f"{size_of(self._config)}, which others perhaps use. There is: {describe_machines()}. See `ray "
                f"status`. {CONTINUE}"
            )

    def _check_facts(self, worker: Worker, facts: dict[str, str]) -> None:
        wrong = [
            f"{name} {theirs} there, {self._facts[name]} here"
            for name, theirs in facts.items()
            if theirs != self._facts[name]
        ]
        if wrong:
            raise ClusterError(
                f"A worker on {worker.host} would not record the same bytes: {'; '.join(wrong)}. Install the same on "
                "all machines, and start Ray there again."
            )

    def _check_fingerprint(self, worker: Worker, fingerprint: str) -> None:
        if fingerprint != self._fingerprint:
            raise ClusterError(
                f"A worker on {worker.host} would not record the same bytes: it has the same packages, but computes "
                "other numbers for the same episode than this machine. Its processor or its system's mathematics "
                "library differs. Use machines of one kind, this one among them."
            )

    def _print(self, worker: Worker, lines: list[str]) -> None:
        """Print what a worker printed: each line once, however many workers print it."""
        for line in lines:
            self._printed[line] += 1
            if self._printed[line] == 1 and len(self._printed) <= _PRINTED:
                more = " (further lines of this kind are left out)" if len(self._printed) == _PRINTED else ""
                self._console.print(f"[dim]{escape(f'[{worker.host}]')}[/dim] {escape(line)}{more}", highlight=False)
