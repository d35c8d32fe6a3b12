"""A Ray cluster: found or started, within a bounded time, and left as it was."""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from bhd_lerobot.cluster.config import RayConfig, check_address
from bhd_lerobot.errors import ClusterError

_LOCAL = "local"
_KNOCK_S = 5.0  # a machine that is there answers a connection much sooner
_OBJECT_STORE = 256 * 2**20  # bytes of episodes on their way; more of them spill to the disk
_REMEDY = (
    "Start one with `ray start --head --port=6379`, join it from each other machine, this one too, with "
    "`ray start --address=HOST:6379`, and see it with `ray status`."
)


@contextmanager
def connected(config: RayConfig) -> Iterator[str]:
    """Be a driver of the cluster that a configuration names, its own without telemetry and ended at the end.

    Raises:
        ClusterError: there is none, it does not answer in time, or it runs other versions; the message names it.
    """
    # Read when the module is imported, and by the processes that it starts.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    address = config.address or os.environ.get("RAY_ADDRESS") or _LOCAL
    check_address(address, "ray.address" if config.address else "RAY_ADDRESS")
    if ray.is_initialized():  # by a program that uses us: it decides about its cluster
        yield address
        return
    options: dict[str, Any] = {"address": address, "log_to_driver": True, "logging_level": "ERROR"}
    if address == _LOCAL:
        wanted = (config.num_workers or 1) * config.cpus_per_worker
        options |= {
            "num_cpus": max(len(os.sched_getaffinity(0)), wanted),
            "include_dashboard": config.include_dashboard,
            "object_store_memory": _OBJECT_STORE,
        }
    elif address != "auto":
        _knock(address)
    try:
        with _errors(address):
            if address == _LOCAL:
                # Not in a thread: the system ends the cluster's processes with the thread that started them.
                former = signal.getsignal(signal.SIGTERM)  # in whose place Ray puts its own
                try:
                    ray.init(**options)
                finally:
                    if threading.current_thread() is threading.main_thread():
                        signal.signal(signal.SIGTERM, former)
            else:
                _join(lambda: ray.init(**options), address, config.timeout_s)
        yield address
    finally:
        ray.shutdown()


def _join(join: Callable[[], Any], address: str, timeout_s: float) -> None:
    """Join a cluster, in a thread of its own: Ray itself tries for minutes, and cannot be interrupted."""
    failed: list[BaseException] = []

    def call() -> None:
        try:
            join()
        except BaseException as error:  # Ray also raises SystemExit
            failed.append(error)

    thread = threading.Thread(target=call, name="bhd-ray-join", daemon=True)
    thread.start()
    thread.join(timeout_s)
    if thread.is_alive():
        raise ClusterError(
            f"The Ray cluster at {address!r} did not answer within {timeout_s:g} s (ray.timeout_s). Is it Ray's port, "
            f"and is this machine part of the cluster? {_REMEDY}"
        )
    if failed:
        raise failed[0]


@contextmanager
def _errors(address: str) -> Iterator[None]:
    """Say in our words why there is no cluster."""
    try:
        yield
    except ClusterError:
        raise
    except (Exception, SystemExit) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        if "ersion mismatch" in reason:
            raise ClusterError(
                f"The Ray cluster at {address!r} runs other versions than this program. {reason} Install the same on "
                "all machines and start the cluster again."
            ) from error
        if address == "auto":
            raise ClusterError(f"There is no Ray cluster on this machine (ray.address=auto). {_REMEDY}") from error
        raise ClusterError(
            f"The Ray cluster at {address!r} cannot be used: {reason}. If it was started with a token, set "
            f"RAY_AUTH_MODE=token here, too. {_REMEDY}"
        ) from error


def _knock(address: str) -> None:
    """See that something answers at an address, before Ray tries it for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_KNOCK_S).close()
    except OSError as error:
        what = "does not answer" if isinstance(error, TimeoutError) else f"cannot be reached: {error.strerror or error}"
        raise ClusterError(f"The Ray cluster at {address!r} {what}. {_REMEDY}") from error


def free_places(config: RayConfig) -> int:
    """Return how many workers the machines of the cluster have room for, if nobody else uses them."""
    total = 0
    for resources in _machines().values():
        places = resources.get("CPU", 0) // config.cpus_per_worker
        if config.gpus_per_worker:
            places = min(places, resources.get("GPU", 0) / config.gpus_per_worker)
        total += int(places)
    return total


def describe_crowding(config: RayConfig, workers: int) -> str:
    """Return a message if a run wants more workers than there are processors; empty if not."""
    places = free_places(config)
    if workers > places:
        return (
            f"ray.num_workers is {config.num_workers}, and the cluster has room for {places} of {size_of(config)}: "
            f"{places} run at a time. The others start if there is more room. There is: {describe_machines()}."
        )
    address = config.address or os.environ.get("RAY_ADDRESS") or _LOCAL
    needed, there = workers * config.cpus_per_worker, len(os.sched_getaffinity(0))
    if address == _LOCAL and needed > there:
        return f"{workers} workers of {size_of(config)} share the {there} processors of this machine."
    return ""


def size_of(config: RayConfig) -> str:
    """Return the size of a worker as text."""
    cpus, gpus = config.cpus_per_worker, config.gpus_per_worker
    return f"{cpus} CPU{'' if cpus == 1 else 's'}" + (f" and {gpus:g} GPU{'' if gpus == 1 else 's'}" if gpus else "")


def describe_machines() -> str:
    """Return the machines of the cluster as text, for a message."""
    machines = [f"{name} with {r.get('CPU', 0):g} CPUs and {r.get('GPU', 0):g} GPUs" for name, r in _machines().items()]
    return "; ".join(machines[:8] + (["…"] if len(machines) > 8 else [])) or "none"


def _machines() -> dict[str, dict[str, float]]:
    """Return the resources of the machines that are alive."""
    import ray

    found: dict[str, dict[str, float]] = {}
    with contextlib.suppress(ConnectionError):
        for number, node in enumerate(ray.nodes()):
            if node["Alive"]:
                found[f"{node['NodeManagerHostname']} ({number})"] = node["Resources"]
    return found
