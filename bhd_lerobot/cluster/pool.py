"""The workers of a cluster: started, given episodes, and replaced when they are lost."""

import contextlib
import heapq
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cluster.cluster import describe_crowding, describe_machines, free_places, size_of
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.job import Job
from bhd_lerobot.cluster.remote import RemoteWorker, facts_of_machine
from bhd_lerobot.errors import ClusterError

CONTINUE = "What was recorded is saved; the same command runs the rest, bhd-record with --resume=true."
_QUEUED = 2  # tasks that a worker has at a time: it continues with the next while a result travels
_WINDOW = 4  # tasks for each worker, finished or not, by which the run may be ahead of the oldest that is missing
_DEATHS = 3  # of workers, with the same task in hand
_STARTS = 5  # of workers that are lost before they are there, in a row
_POLL_S = 0.2
_LOGS = "Ray's logs are on that machine, in /tmp/ray/session_latest/logs."


@dataclass(order=True)
class Task:
    """Some episodes, by number and seed, for one worker.

    Attributes:
        number: its place in the run.
        deaths: how many workers were lost with it in hand. Then it runs alone: the result of an earlier task may be
            lost with its worker, and nobody could say which of several was running.
    """

    number: int
    specs: list[tuple[int, int]] = field(compare=False)
    deaths: int = field(default=0, compare=False)

    def __str__(self) -> str:
        """The episodes as text."""
        first, last = self.specs[0][0], self.specs[-1][0]
        return f"episode {first}" if first == last else f"episodes {first} to {last}"


@dataclass(eq=False)
class Worker:
    """A process of the cluster, with what it was given and has not finished, the running task first."""

    actor: Any
    host: str = ""
    tasks: deque[Task] = field(default_factory=deque)


class WorkerPool:
    """Runs tasks on workers and gives their results in order. Use it as a context manager.

    `ActorPool` of Ray does not say whose result was lost with its worker, and an actor that Ray restarts by itself
    takes no calls meanwhile: both are done here.
    """

    def __init__(self, config: RayConfig, console: Console, server: str = "bhd_lerobot.cluster.job") -> None:
        self._config, self._console, self._server = config, console, server
        self._workers: list[Worker] = []
        self._calls: dict[Any, tuple[Worker, Task | None]] = {}  # without a task: where a new worker is
        self._runs = self._lost_early = 0
        self._has_described_crowding = False

    def run(self, job: Job, fingerprint: str, tasks: Sequence[Task], stop: Callable[[], bool]) -> Iterator[Any]:
        """Yield the results of tasks, in their order; ends early when `stop`, called often, returns true.

        Workers that compute another fingerprint than this machine are refused.

        Raises:
            ClusterError: no worker could be started, or they are lost again and again.
            Exception: what a worker raised, once everything before it was yielded.
        """
        import ray

        wanted = self.workers_for(len(tasks))
        if not self._has_described_crowding and (crowding := describe_crowding(self._config, wanted)):
            self._console.print(escape(crowding), soft_wrap=True, highlight=False)
            self._has_described_crowding = True
        more = (*(("torch", "safetensors") if job.checkpoints else ()), *(("av",) if job.video is not None else ()))
        self._runs += 1
        self._order = {
            "number": self._runs,
            "more": more,
            "facts": facts_of_machine(more),
            "fingerprint": fingerprint,
            "server": self._server,
            "job": [ray.put(pickle.dumps(job, pickle.HIGHEST_PROTOCOL))],
        }
        self._waiting, self._done = list(tasks), dict[int, Any]()
        self._there_at = time.monotonic()
        try:
            for place in range(len(tasks)):
                while place not in self._done:
                    if stop():
                        return
                    self._step(wanted, place + _WINDOW * wanted)
                result = self._done.pop(place)
                yield result
                if "error" in result:
                    raise result["error"]
        finally:
            self._dismiss(lambda worker: bool(worker.tasks))

    def workers_for(self, tasks: int) -> int:
        """Return how many workers some tasks will have; at least one must have room on a machine."""
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
        import ray

        for worker in filter(which, list(self._workers)):
            self._workers.remove(worker)
            self._calls = {reference: call for reference, call in self._calls.items() if call[0] is not worker}
            with contextlib.suppress(ray.exceptions.RayError):
                ray.kill(worker.actor)

    def _step(self, wanted: int, limit: int) -> None:
        """Keep all workers busy with tasks below a number, and take in what was answered."""
        import ray

        while len(self._workers) < wanted:
            size = {"num_cpus": self._config.cpus_per_worker, "num_gpus": self._config.gpus_per_worker}
            worker = Worker(ray.remote(RemoteWorker).options(**size, scheduling_strategy="SPREAD").remote())
            self._workers.append(worker)
            self._calls[worker.actor.host.remote()] = worker, None
        for worker in self._workers:
            while worker.host and len(worker.tasks) < _QUEUED and self._waiting and self._waiting[0].number < limit:
                if worker.tasks and (self._waiting[0].deaths or worker.tasks[0].deaths):
                    break
                task = heapq.heappop(self._waiting)
                worker.tasks.append(task)
                self._calls[worker.actor.run.remote(self._order, task.specs)] = worker, task
        answered, _ = ray.wait(list(self._calls), num_returns=1, timeout=_POLL_S)
        for reference in answered:
            worker, asked = self._calls.pop(reference)
            try:
                answer = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise ClusterError(f"A worker on {worker.host or 'a machine'} failed: {error}") from error
            except ray.exceptions.RayError as error:
                self._replace(worker, error)
                continue
            if asked is None:
                worker.host, self._lost_early = answer, 0
            else:
                worker.tasks.remove(asked)
                self._done[asked.number] = answer
        if any(worker.host for worker in self._workers):
            self._there_at = time.monotonic()
        elif time.monotonic() - self._there_at > self._config.timeout_s:
            raise ClusterError(
                f"No worker could be started within {self._config.timeout_s:g} s (ray.timeout_s): each asks for "
                f"{size_of(self._config)}, which others perhaps use. There is: {describe_machines()}. See `ray "
                f"status`. {CONTINUE}"
            )

    def _replace(self, worker: Worker, error: BaseException) -> None:
        """Give a worker up and its tasks to others."""
        host = worker.host or "a machine that had not answered yet"
        lines = [line.strip() for line in str(error).splitlines() if line.strip() and "class_name" not in line]
        if lines and "creation task" in lines[0]:
            raise ClusterError(
                f"A worker could not be started: {lines[-1]}. Install this package, as it is here, on all machines, "
                "and start Ray there again."
            ) from error
        cause = " ".join(lines)[:300]
        self._dismiss(lambda one: one is worker)
        self._lost_early += not worker.host
        if self._lost_early >= _STARTS:
            raise ClusterError(f"{_STARTS} workers in a row were lost at their start: {cause} {_LOGS}") from error
        for task in worker.tasks:
            task.deaths += 1
            if task.deaths >= _DEATHS:
                raise ClusterError(
                    f"{_DEATHS} workers were lost while they ran {task}, the last on {host}: {cause} Perhaps it needs "
                    f"more memory than they have: lower --n_envs or --ray.episodes_per_task. {_LOGS} {CONTINUE}"
                ) from error
            heapq.heappush(self._waiting, task)
        again = f"; {', '.join(map(str, worker.tasks))} will be run again" if worker.tasks else ""
        self._console.print(f"A worker was lost ({escape(host)}){again}: {escape(cause)}", highlight=False)
