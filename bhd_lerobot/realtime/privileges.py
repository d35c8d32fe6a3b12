"""Real-time privileges of a process, so that it wakes up on time: requested, reported, given back.

Nothing here is needed for a simulation in lockstep. Each request may be refused; a refusal is reported with its remedy.
"""

import ctypes
import gc
import os
import resource
import struct
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from bhd_lerobot.errors import ConfigError, RealtimeError

MCL_CURRENT, MCL_FUTURE = 1, 2  # <sys/mman.h> of x86 and ARM, for which MuJoCo has wheels
CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23  # <linux/capability.h>
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30  # <linux/prctl.h>
_CPU_LATENCY = "/dev/cpu_dma_latency"


class SystemCalls:
    """The real kernel. Every method raises OSError where the kernel refuses."""

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)

    def scheduler(self) -> tuple[int, int]:
        """Return the policy, with its flags, and the priority of the calling thread."""
        return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority

    def set_scheduler(self, policy: int, priority: int) -> None:
        """Set policy, with its flags, and priority of the calling thread."""
        os.sched_setscheduler(0, policy, os.sched_param(priority))

    def affinity(self) -> set[int]:
        """Return the processors that the calling thread may run on."""
        return os.sched_getaffinity(0)

    def set_affinity(self, processors: set[int]) -> None:
        """Set the processors that the calling thread may run on."""
        os.sched_setaffinity(0, processors)

    def timer_slack(self) -> int:
        """Return by how much the kernel may delay timers of the calling thread [ns]."""
        return self._call("prctl", _PR_GET_TIMERSLACK, 0, 0, 0, 0)

    def set_timer_slack(self, slack: int) -> None:
        """Set by how much the kernel may delay timers of the calling thread [ns]; 0 is the default."""
        self._call("prctl", _PR_SET_TIMERSLACK, slack, 0, 0, 0)

    def lock_memory(self, flags: int) -> None:
        """Keep the pages of this process in memory."""
        self._call("mlockall", flags)

    def unlock_memory(self) -> None:
        """Let pages go again."""
        self._call("munlockall")

    def hold_cpu_latency(self, latency_us: int) -> int:
        """Ask that a processor wakes up within a time [µs]; in force until the returned file is closed."""
        handle = os.open(_CPU_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
        try:
            os.write(handle, struct.pack("@i", latency_us))
        except OSError:
            os.close(handle)
            raise
        return handle

    def close(self, handle: int) -> None:
        """Close a file."""
        os.close(handle)

    def limit(self, which: int) -> int:
        """Return a soft limit, one of the constants of `resource`; RLIM_INFINITY is -1."""
        return resource.getrlimit(which)[0]

    def capabilities(self) -> int:
        """Return the effective capabilities of the calling thread, one bit each; 0 where they cannot be read."""
        try:
            status = Path("/proc/thread-self/status").read_text(encoding="ascii", errors="replace")
        except OSError:
            return 0
        return next((int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff:")), 0)

    def _call(self, name: str, *arguments: int) -> int:
        result = int(getattr(self._libc, name)(*map(ctypes.c_ulong, arguments)))
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        return result


SLACK_NS = 1  # 0 would mean "the default"

# Remedies, in which {python} is the interpreter and {rtprio} the priority that the limit has to allow.
GRANT_RIGHTS = (
    "one of: (1) `sudo setcap cap_sys_nice,cap_ipc_lock+ep {python}`; (2) the lines `@realtime - rtprio {rtprio}` and "
    "`@realtime - memlock unlimited` in `/etc/security/limits.d/99-realtime.conf`, yourself in the group `realtime`, "
    "and a new login; (3) in a container, start it with `--cap-add=SYS_NICE --cap-add=IPC_LOCK --ulimit "
    "rtprio={rtprio} --ulimit memlock=-1`"
)
GRANT_BANDWIDTH = (
    "give the control group real-time time (cgroup v1: `cpu.rt_runtime_us`) or leave it; see that `sysctl "
    "kernel.sched_rt_runtime_us` is not 0; in a rootless container or a user namespace the capability does not count: "
    "raise `rtprio` outside of it"
)
GRANT_LATENCY_FILE = (
    'a udev rule: `KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"`; in a container, start it with '
    "`--device=/dev/cpu_dma_latency`; or `cpupower idle-set -D 10`"
)


def real_interpreter() -> str:
    """Return the file that runs this program.

    Capabilities belong to a file, and the `python` of a virtual environment is a symbolic link: what is granted to the
    file behind it is granted to every environment made from the same interpreter. (`python -m venv --copies` makes an
    environment with a file of its own.)
    """
    return os.path.realpath(sys.executable)


@dataclass(frozen=True)
class RealtimeSettings:
    """The privileges that a real-time process requests.

    Attributes:
        priority: priority under SCHED_FIFO, 1 to 99, larger is more urgent. The kernel's own interrupt threads have 50.
        lock_memory: keep all pages in memory, so that none has to be fetched within a tick.
        hold_cpu_latency: keep processors out of sleep states that take time to leave. Costs power.
        freeze_collector: keep the garbage collector from running; reference counting continues.
        affinity: processors to run on; those of the parent if empty.
        require: raise an error where SCHED_FIFO is refused, instead of continuing without it.

    Raises:
        ConfigError: the priority or a processor is not one that there is.
    """

    priority: int = 80
    lock_memory: bool = True
    hold_cpu_latency: bool = True
    freeze_collector: bool = True
    affinity: tuple[int, ...] = ()
    require: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.priority, bool) or not isinstance(self.priority, int) or not 1 <= self.priority <= 99:
            raise ConfigError(f"The real-time priority is {self.priority!r}; it must be a whole number from 1 to 99.")
        there = os.sched_getaffinity(0) if self.affinity else set()
        wrong = [cpu for cpu in self.affinity if isinstance(cpu, bool) or cpu not in there]
        if wrong:
            raise ConfigError(
                f"The affinity names processor(s) {', '.join(map(repr, wrong))}; this process may run on "
                f"{', '.join(map(str, sorted(there)))}. Leave the affinity empty, or take some of these."
            )


@dataclass(frozen=True)
class Grant:
    """The result of one request.

    Attributes:
        name: "affinity", "collector", "memory lock", "cpu latency", "timer slack" or "scheduler".
        wanted: the request.
        granted: whether it is in force.
        detail: the present state.
        remedy: how to have it granted; empty where it was.
    """

    name: str
    wanted: str
    granted: bool
    detail: str
    remedy: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, as JSON can hold them."""
        return asdict(self)


class Privileges:
    """Acquires the privileges of `RealtimeSettings`, and gives them back.

    Everything concerns the thread that calls `acquire` or its whole process, and `release` must be called from the
    same thread. Threads and processes started later run under SCHED_OTHER (reset on fork).

    Args:
        calls: how to reach the kernel; the real one if None.
    """

    def __init__(self, calls: SystemCalls | None = None) -> None:
        self._calls = calls or SystemCalls()
        self._undo = ExitStack()
        self.grants: list[Grant] = []
        """The outcome of each request of `acquire`."""

    def acquire(self, settings: RealtimeSettings) -> list[Grant]:
        """Request everything, each independently of the others.

        What takes long comes before the priority is raised, so that it delays no other process.

        Args:
            settings: what to request.

        Returns:
            One grant for each request, the scheduler's last.

        Raises:
            RealtimeError: SCHED_FIFO was refused and the settings require it, and everything is given back; or this
                was called before without `release`.
        """
        if self.grants:
            raise RealtimeError("The privileges are held already; call release() first.")
        wanted: list[Callable[[RealtimeSettings], Grant]] = [self._timer_slack, self._scheduler]
        if settings.hold_cpu_latency:
            wanted.insert(0, self._cpu_latency)
        if settings.lock_memory:
            wanted.insert(0, self._memory_lock)
        if settings.freeze_collector:
            wanted.insert(0, self._collector)
        if settings.affinity:
            wanted.insert(0, self._affinity)
        try:
            self.grants = [ask(settings) for ask in wanted]
        except BaseException:
            self.release()
            raise
        scheduler = self.grants[-1]
        if settings.require and not scheduler.granted:
            self.release()
            raise RealtimeError(
                f"{scheduler.wanted} is required and was refused. {scheduler.detail} Remedy: {scheduler.remedy}; or go "
                "on without it: require_realtime = false."
            )
        return list(self.grants)

    def release(self) -> None:
        """Give everything back, in reverse order. May be called twice, or without `acquire`."""
        self.grants = []
        self._undo.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.release()

    # --- one request each --------------------------------------------------------------------------------------------

    def _affinity(self, settings: RealtimeSettings) -> Grant:
        wanted = f"processors {', '.join(map(str, sorted(settings.affinity)))}"
        before = self._calls.affinity()
        try:
            self._calls.set_affinity(set(settings.affinity))
        except OSError as error:
            now = f"{_why(error)} It runs on processors {', '.join(map(str, sorted(before)))}."
            return Grant("affinity", wanted, False, now, "take processors that this process may run on, or none")
        self._undo.callback(self._calls.set_affinity, before)
        return Grant("affinity", wanted, True, f"{wanted}.")

    def _collector(self, settings: RealtimeSettings) -> Grant:
        enabled = gc.isenabled()
        gc.collect()
        gc.freeze()
        gc.disable()
        self._undo.callback(gc.unfreeze)
        if enabled:
            self._undo.callback(gc.enable)
        count = gc.get_freeze_count()
        return Grant("collector", "no garbage collection", True, f"Frozen with {count} objects, and off.")

    def _memory_lock(self, settings: RealtimeSettings) -> Grant:
        wanted = "all memory locked"
        limit = self._calls.limit(resource.RLIMIT_MEMLOCK)
        # With a limit, an allocation beyond it would fail in the middle of a tick: worse than waiting for a page.
        bounded = limit != resource.RLIM_INFINITY and not self._capable(CAP_IPC_LOCK)
        try:
            self._calls.lock_memory(MCL_CURRENT if bounded else MCL_CURRENT | MCL_FUTURE)
        except OSError as error:
            limited = f" The limit is {limit // 1024} KiB." if bounded else ""
            return Grant("memory lock", wanted, False, f"{_why(error)}{limited} Nothing is locked.", _rights(settings))
        self._undo.callback(self._calls.unlock_memory)
        if bounded:
            now = f"What there was is locked; what comes is not, because the limit is {limit // 1024} KiB."
            return Grant("memory lock", wanted, False, now, _rights(settings))
        return Grant("memory lock", wanted, True, "All memory is locked, present and future.")

    def _cpu_latency(self, settings: RealtimeSettings) -> Grant:
        wanted = "0 µs to wake a processor"
        try:
            handle = self._calls.hold_cpu_latency(0)
        except OSError as error:
            now = f"{_why(error)} Idle processors may sleep deeply."
            return Grant("cpu latency", wanted, False, now, GRANT_LATENCY_FILE)
        self._undo.callback(self._calls.close, handle)
        return Grant("cpu latency", wanted, True, "Held at 0 µs.")

    def _timer_slack(self, settings: RealtimeSettings) -> Grant:
        # Under SCHED_FIFO there is none; set it in any case, for the fall-back.
        wanted = f"timer slack {SLACK_NS} ns"
        before = self._calls.timer_slack()
        try:
            self._calls.set_timer_slack(SLACK_NS)
        except OSError as error:
            now = f"{_why(error)} The timer slack is {before} ns."
            return Grant("timer slack", wanted, False, now, "allow prctl(PR_SET_TIMERSLACK) in the sandbox's filter")
        self._undo.callback(self._restore_slack, before)
        return Grant("timer slack", wanted, True, f"{self._calls.timer_slack()} ns.")

    def _restore_slack(self, before: int) -> None:
        with suppress(OSError):
            self._calls.set_timer_slack(before)

    def _scheduler(self, settings: RealtimeSettings) -> Grant:
        wanted = f"SCHED_FIFO priority {settings.priority}, reset on fork"
        policy, priority = self._calls.scheduler()
        try:
            self._calls.set_scheduler(os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, settings.priority)
        except OSError as error:
            now = (
                f"{_why(error)} It runs under {_policy(policy)} with a timer slack of {self._calls.timer_slack()} ns: "
                "wake-ups come later, and any other process can delay them."
            )
            limit = self._calls.limit(resource.RLIMIT_RTPRIO)
            may = self._capable(CAP_SYS_NICE) or limit == resource.RLIM_INFINITY or limit >= settings.priority
            return Grant("scheduler", wanted, False, now, GRANT_BANDWIDTH if may else _rights(settings))
        self._undo.callback(self._restore_scheduler, policy, priority)
        return Grant("scheduler", wanted, True, f"{wanted}.")

    def _restore_scheduler(self, policy: int, priority: int) -> None:
        try:
            self._calls.set_scheduler(policy, priority)
        except PermissionError:
            # Who has the priority by limit and not by capability may leave SCHED_FIFO, but not clear the flag.
            self._calls.set_scheduler(policy | os.SCHED_RESET_ON_FORK, priority)

    def _capable(self, capability: int) -> bool:
        return bool(self._calls.capabilities() >> capability & 1)


def _rights(settings: RealtimeSettings) -> str:
    return GRANT_RIGHTS.format(python=real_interpreter(), rtprio=max(95, settings.priority))


def _why(error: OSError) -> str:
    return f"The kernel refused: {error.strerror or error}."


def _policy(policy: int) -> str:
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_BATCH: "SCHED_BATCH", os.SCHED_IDLE: "SCHED_IDLE"}
    names |= {os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    return names.get(policy & ~os.SCHED_RESET_ON_FORK, f"policy {policy}")
