"""The machine that is measured on: what it is, how busy others keep it, and its processors held awake."""

import os
import platform
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_DMA_LATENCY = Path("/dev/cpu_dma_latency")


@contextmanager
def processors_awake() -> Iterator[str]:
    """Hold /dev/cpu_dma_latency at 0 for all loops alike; yields "held" or why the system refused it."""
    try:
        handle = os.open(_DMA_LATENCY, os.O_WRONLY)
    except OSError as error:
        yield f"refused: {error.strerror} (run as root, or give this user write access to {_DMA_LATENCY})"
        return
    try:
        os.write(handle, struct.pack("i", 0))
        yield "held at 0"
    finally:
        os.close(handle)  # the kernel forgets the request then


@dataclass(frozen=True)
class CpuTimes:
    """What the processors did since the machine started, in ticks of the kernel's accounting.

    Attributes:
        busy: running anything.
        stolen: ready to run something while the host ran another machine.
        total: all of it, with the time of doing nothing.
    """

    busy: int
    stolen: int
    total: int

    @classmethod
    def parse(cls, stat: str) -> "CpuTimes":
        """Read the contents of /proc/stat."""
        # user nice system idle iowait irq softirq steal; what follows is contained in user and nice
        fields = [int(word) for word in stat.splitlines()[0].split()[1:9]]
        idle, stolen = fields[3] + fields[4], fields[7]
        return cls(sum(fields) - idle - stolen, stolen, sum(fields))

    @classmethod
    def now(cls) -> "CpuTimes":
        """Read the kernel's accounting."""
        return cls.parse(Path("/proc/stat").read_text(encoding="ascii"))

    def shares_since(self, earlier: "CpuTimes") -> tuple[float, float]:
        """Return the shares of all processor time that were busy and stolen since an earlier reading."""
        total = self.total - earlier.total
        if total <= 0:
            return 0.0, 0.0
        return (self.busy - earlier.busy) / total, (self.stolen - earlier.stolen) / total


def describe() -> dict[str, Any]:
    """Return what readers need to know of the machine to judge its numbers."""
    return {
        "kernel": f"{platform.system()} {platform.release()}",
        "preemption": "PREEMPT_RT" if Path("/sys/kernel/realtime").exists() else _kind_of_kernel(platform.version()),
        "machine": platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "clock_source": _read("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
        "rt_runtime_us": _read("/proc/sys/kernel/sched_rt_runtime_us"),
        "python": platform.python_version(),
    }


def _kind_of_kernel(version: str) -> str:
    return next((word for word in version.split() if word.startswith("PREEMPT")), "no preemption named")


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"
