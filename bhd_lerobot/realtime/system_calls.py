"""The system calls of a real-time process, in one object, so that a test can refuse them. Linux."""

import ctypes
import os
import resource
import struct
from pathlib import Path

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
        """Keep the pages of this process in memory.

        Args:
            flags: MCL_CURRENT, MCL_FUTURE, or both.
        """
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
        """Call a function of the C library, every argument an unsigned long."""
        result = int(getattr(self._libc, name)(*map(ctypes.c_ulong, arguments)))
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        return result
