"""Everything the doctor can complain of, in one list, from which the documentation has its table."""

import re
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from bhd_lerobot.realtime.privileges import GRANT_BANDWIDTH, GRANT_LATENCY_FILE, GRANT_RIGHTS


class Status(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARNING = "warning"
    """It works, but later, slower or with something left out."""
    PROBLEM = "problem"
    """Something that a recording with the default options needs does not work."""


@dataclass(frozen=True)
class Complaint:
    """One row of the documentation's table; ``{name}`` stands for a value.

    Attributes:
        check: the check that complains.
        status: how bad it is.
        symptom: what a user notices.
        cause: why.
        remedy: what to do.
    """

    check: str
    status: Status
    symptom: str
    cause: str
    remedy: str


@dataclass(frozen=True)
class Finding:
    """What a check found; symptom, cause and remedy are empty where all is well."""

    check: str
    status: Status
    found: str
    symptom: str = ""
    cause: str = ""
    remedy: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, as JSON can hold them."""
        return asdict(self)


def fine(check: str, found: str) -> Finding:
    """Return the finding that all is well."""
    return Finding(check, Status.OK, found)


def complain(key: str, found: str, **values: object) -> Finding:
    """Return the finding of a complaint.

    Args:
        key: of `COMPLAINTS`.
        found: what was measured or read.
        values: for what stands in braces in the complaint's texts.
    """
    one = COMPLAINTS[key]
    texts = [text.format(**values) for text in (one.symptom, one.cause, one.remedy)]
    return Finding(one.check, one.status, found, *texts)


def markdown_table() -> str:
    """Return the table of the documentation, with "…" for values."""
    rows = ["| check | | symptom | cause | remedy |", "|---|---|---|---|---|"]
    for one in COMPLAINTS.values():
        texts = [re.sub(r"\{\w+\}", "…", text) for text in (one.symptom, one.cause, one.remedy)]
        rows.append(f"| {one.check} | {one.status} | {' | '.join(texts)} |")
    return "\n".join(rows) + "\n"


_W, _P = Status.WARNING, Status.PROBLEM
_RIGHTS = GRANT_RIGHTS.replace("{rtprio}", "95")
_REINSTALL = "`make venv` in the checkout, or `pip install -e .` there in the environment that you use"

COMPLAINTS: dict[str, Complaint] = {
    "python": Complaint(
        "Python",
        _P,
        "packages cannot be installed or imported",
        "Python {version} is not one of those supported, {asked}",
        "make the environment with Python 3.12 or 3.13: `PYTHON=/path/to/python3.12 make test`",
    ),
    "package.missing": Complaint(
        "versions",
        _P,
        "imports fail, or LeRobot does not know our robots",
        "`{name}` is not installed in this environment",
        _REINSTALL,
    ),
    "package.version": Complaint(
        "versions",
        _P,
        "errors about arguments, attributes or types that there are not",
        "`{name}` is {version}; asked for is {asked}",
        _REINSTALL,
    ),
    "package.extra": Complaint(
        "versions",
        _W,
        "errors about arguments, attributes or types that there are not, where the extra {extra} is used",
        "`{name}` is {version}; the extra {extra} asks for {asked}",
        "nothing, if you do not use it; otherwise `pip install -e '.[{extra}]'` in the checkout",
    ),
    "plugins.error": Complaint(
        "plug-ins",
        _P,
        "every `lerobot-*` command fails",
        "LeRobot cannot be imported: {error}",
        "mend what the message names, or " + _REINSTALL,
    ),
    "plugins.missing": Complaint(
        "plug-ins",
        _P,
        "`--robot.type=turtlebot3` or `--teleop.type=bhd_brain` is an invalid choice for `lerobot-record`",
        "LeRobot did not find {missing}: `lerobot_robot_bhd` is not installed, or its import failed. {error}",
        _REINSTALL,
    ),
    "opengl.missing": Complaint(
        "OpenGL",
        _W,
        "no camera images, and no film of an episode",
        "no OpenGL that renders without a display. {error}",
        "`apt-get install libegl1 libgl1`, with and without a GPU; unset `MUJOCO_GL`; or leave the cameras off",
    ),
    "opengl.crash": Complaint(
        "OpenGL",
        _P,
        "a recording ends without a message, or hangs, as soon as an image is rendered",
        "the OpenGL driver does not work: {error}",
        "`apt-get install libosmesa6` and `MUJOCO_GL=osmesa`; or mend the driver",
    ),
    "opengl.blank": Complaint(
        "OpenGL",
        _P,
        "all images are of one colour",
        "the OpenGL driver {driver} renders nothing",
        "`apt-get install libosmesa6` and `MUJOCO_GL=osmesa`; or mend the driver",
    ),
    "ffmpeg": Complaint(
        "FFmpeg",
        _P,
        "no film of an episode; datasets with cameras can be neither written nor read",
        "PyAV, which brings FFmpeg, cannot encode H.264: {error}",
        "`pip install --force-reinstall av`",
    ),
    "scheduler.rights": Complaint(
        "scheduler",
        _W,
        "with `robot.clock = realtime` ticks are late as soon as anything else runs",
        "this process may not use SCHED_FIFO",
        _RIGHTS,
    ),
    "scheduler.bandwidth": Complaint(
        "scheduler",
        _W,
        "with `robot.clock = realtime` ticks are late as soon as anything else runs",
        "this process has the right to SCHED_FIFO, and its control group or its container refuses",
        GRANT_BANDWIDTH,
    ),
    "scheduler.error": Complaint(
        "scheduler",
        _P,
        "the real-time process does not start",
        "a process that asks for real-time rights ends: {error}",
        "look for a sandbox (seccomp) that kills, or a memory limit of the container that locked memory exceeds",
    ),
    "memory": Complaint(
        "memory lock",
        _W,
        "single ticks are late by milliseconds when memory is short",
        "this process may not lock its memory",
        _RIGHTS,
    ),
    "latency": Complaint(
        "cpu latency",
        _W,
        "an idle machine wakes up later than a busy one",
        "`/dev/cpu_dma_latency` cannot be held at 0, so processors sleep deeply",
        GRANT_LATENCY_FILE,
    ),
    "kernel": Complaint(
        "kernel",
        _W,
        "rarely, under load, a tick is late by milliseconds",
        "the kernel was not built with PREEMPT_RT",
        "for a simulation, and where `--realtime` is content: nothing. For hardware: a kernel with PREEMPT_RT "
        "(`apt-get install linux-image-rt-amd64`, `pro enable realtime-kernel`)",
    ),
    "throttling.off": Complaint(
        "RT throttling",
        _W,
        "a real-time process that hangs takes a processor until the machine is switched off",
        "`kernel.sched_rt_runtime_us` is -1",
        "`sysctl -w kernel.sched_rt_runtime_us=950000`",
    ),
    "throttling.low": Complaint(
        "RT throttling",
        _W,
        "the real-time process stands still for a part of every second, or is refused",
        "real-time processes may use only {share} of a processor's time",
        "`sysctl -w kernel.sched_rt_runtime_us=950000`",
    ),
    "clock": Complaint(
        "clock source",
        _W,
        "every reading of the clock takes microseconds, and ticks are late",
        "the kernel measures time with {source}",
        "the kernel parameter `clocksource=tsc`, if `dmesg` does not call the TSC unstable; in a virtual machine the "
        "host's clock (`kvm-clock`)",
    ),
    "shm.missing": Complaint(
        "shared memory",
        _P,
        "`robot.clock = realtime` and LeRobot's data loader do not start",
        "`/dev/shm` is missing, full or not writable: {error}",
        "`mount -t tmpfs tmpfs /dev/shm`; remove what fills it; in a container: `--shm-size=1g`",
    ),
    "shm.small": Complaint(
        "shared memory",
        _W,
        "training ends with a bus error in a worker of the data loader",
        "`/dev/shm` has {free} left",
        "in a container: `--shm-size=1g`; or `--num_workers=0`",
    ),
    "disk.denied": Complaint(
        "disk",
        _P,
        "a recording cannot be saved",
        "{folder} cannot be written: {error}",
        "another `dataset.root`, or its permissions",
    ),
    "disk.full": Complaint(
        "disk",
        _P,
        "a recording ends with an error when an episode is saved",
        "{folder} has {free} left",
        "free some space, or another `dataset.root`",
    ),
    "disk.low": Complaint(
        "disk",
        _W,
        "a long recording with cameras may not fit",
        "{folder} has {free} left",
        "free some space, or another `dataset.root`",
    ),
    "disk.slow": Complaint(
        "disk",
        _W,
        "saving an episode takes long",
        "{folder} takes {speed}, which a network file system may be",
        "a `dataset.root` on a local disk; copy the dataset afterwards",
    ),
    "wakeup.late": Complaint(
        "wake-up",
        _W,
        "at {rate} Hz a part of each period is lost to waiting",
        "{share} of the period passes before 99 % of the wake-ups: other load, a busy host, or rights that were "
        "refused",
        "mend what stands above; leave a processor free of other work; a lower `control_hz`",
    ),
    "wakeup.missed": Complaint(
        "wake-up",
        _P,
        "at {rate} Hz ticks are missed: the robot stutters, and stops with a fault",
        "{share} of the period passes before 99 % of the wake-ups: other load, a busy host, or rights that were "
        "refused",
        "mend what stands above; leave a processor free of other work; a lower `control_hz`, or "
        "`robot.clock = lockstep`",
    ),
    "wakeup.error": Complaint(
        "wake-up",
        _P,
        "the wake-up latency cannot be measured",
        "the measuring process ends: {error}",
        "see the row of the scheduler",
    ),
}
