"""The doctor's checks, each of one thing, and the table of everything that they can find to be wrong."""

import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib import metadata
from pathlib import Path

import yaml
from packaging.specifiers import SpecifierSet

from bhd_lerobot.apps.doctor.trials import Outcome
from bhd_lerobot.realtime.privileges import (
    GRANT_BANDWIDTH,
    GRANT_LATENCY_FILE,
    GRANT_RIGHTS,
    Grant,
    real_interpreter,
)
from bhd_lerobot.versions import DISTRIBUTION, required_versions

ROBOTS = ("turtlebot3", "ur5")
TELEOPERATORS = ("bhd_brain", "bhd_keyboard_arm", "bhd_keyboard_base")

# Of the period, for the latest wake-up. What is lost to waiting is lost to the tick: beyond a half, one of a quarter of
# the period has no reserve.
LATE_SHARE = 0.50

_SLOW_CLOCKS = ("hpet", "acpi_pm", "pit", "jiffies", "refined-jiffies")
_MIB, _GIB = 2**20, 2**30
_SHM_NEEDED = 16 * _MIB  # the blocks of some robots
_SHM_ENOUGH = 128 * _MIB  # a container has 64 MiB by default, too little for the workers of a data loader
_DISK_NEEDED, _DISK_ENOUGH = _GIB, 10 * _GIB
_DISK_SPEED = 20e6  # [B/s]
_TRIAL = 32 * _MIB


class Status(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARNING = "warning"
    """It works, but later, slower or with something left out."""
    PROBLEM = "problem"
    """Something that a recording with the default options needs does not work."""


@dataclass(frozen=True)
class Finding:
    """What a check found, and what a user notices, why, and what to do; empty where all is well."""

    check: str
    status: Status
    symptom: str = ""
    cause: str = ""
    remedy: str = ""
    found: str = ""


_REMEDIES = {
    "{RIGHTS}": GRANT_RIGHTS.replace("{rtprio}", "95"),
    "{BANDWIDTH}": GRANT_BANDWIDTH,
    "{LATENCY_FILE}": GRANT_LATENCY_FILE,
}


def _read_rows() -> dict[str, Finding]:
    rows = yaml.safe_load(Path(__file__).with_name("findings.yaml").read_text(encoding="utf-8"))
    return {
        key: Finding(**row | {"status": Status(row["status"]), "remedy": _REMEDIES.get(row["remedy"], row["remedy"])})
        for key, row in rows.items()
    }


ROWS = _read_rows()


def fine(check: str, found: str) -> Finding:
    """Return the finding that all is well."""
    return Finding(check, Status.OK, found=found)


def wrong(key: str, found: str, **values: object) -> Finding:
    """Return a finding of `ROWS`, with what was found, and values for what stands in braces in its texts."""
    row = ROWS[key]
    texts = {name: getattr(row, name).format(**values) for name in ("symptom", "cause", "remedy")}
    return replace(row, found=found, **texts)


def check_python(version: str = platform.python_version()) -> list[Finding]:
    """Check that the package supports this Python."""
    try:
        required = metadata.metadata(DISTRIBUTION)["Requires-Python"]
    except metadata.PackageNotFoundError:
        return [wrong("package.missing", "not installed", name=DISTRIBUTION)]
    if not SpecifierSet(required).contains(version, prereleases=True):
        return [wrong("python", version, version=version, required=required)]
    return [fine("Python", f"{version} at {real_interpreter()}")]


def check_versions(
    shown: Sequence[str] = ("lerobot", "mujoco"), version_of: Callable[[str], str] = metadata.version
) -> list[Finding]:
    """Check that the packages that ours requires are there; those of `shown` get a finding also if all is well."""
    try:
        required = required_versions(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return [wrong("package.missing", "not installed", name=DISTRIBUTION)]
    findings = []
    for name, versions in required.items():
        try:
            version = version_of(name)
        except metadata.PackageNotFoundError:
            findings.append(wrong("package.missing", f"{name} is not installed", name=name))
            continue
        if not versions.contains(version, prereleases=True):
            found = f"{name} {version}"
            findings.append(wrong("package.version", found, name=name, version=version, required=versions))
        elif name in shown:
            findings.append(fine("versions", f"{name} {version}, required: {versions}"))
    return findings


def check_plugins(outcome: Outcome) -> list[Finding]:
    """Judge what `trials.list_plugins` found."""
    if outcome.kind != "value":
        return [wrong("plugins.error", "LeRobot cannot be imported", error=_error(outcome))]
    known = outcome.value
    missing = [f"the robot {name}" for name in ROBOTS if name not in known["robots"]]
    missing += [f"the teleoperator {name}" for name in TELEOPERATORS if name not in known["teleoperators"]]
    if missing:
        return [wrong("plugins.missing", outcome.output, missing=", ".join(missing), error=outcome.output)]
    others = [name for name in known["bodies"] if name not in ROBOTS]
    return [
        fine("plug-ins", f"LeRobot knows {', '.join((*ROBOTS, *others, *TELEOPERATORS))}"),
        *(fine("plug-ins", text) for text in known.get("installed", ())),
        *(wrong("plugins.failed", text, error=text) for text in known["failed"]),
    ]


def check_opengl(outcome: Outcome) -> list[Finding]:
    """Judge the outcome of `trials.render`."""
    if outcome.kind in ("crash", "timeout"):
        return [wrong("opengl.crash", outcome.error, error=_error(outcome))]
    if outcome.kind == "error":
        return [wrong("opengl.missing", "no image", error=outcome.error)]
    driver = outcome.value["driver"]
    if outcome.value["spread"] == 0:
        return [wrong("opengl.blank", driver, driver=driver)]
    return [fine("OpenGL", driver)]


def check_ffmpeg(outcome: Outcome) -> list[Finding]:
    """Judge the outcome of `trials.encode`."""
    if outcome.kind != "value" or outcome.value["bytes"] == 0:
        return [wrong("ffmpeg", "no video", error=_error(outcome) or "it wrote nothing")]
    found = outcome.value
    shared = "there, too" if found["shared"] else "not there, LeRobot uses PyAV"
    return [
        fine("FFmpeg", f"PyAV {found['pyav']}, libavcodec {found['libavcodec']}; libraries for torchcodec: {shared}")
    ]


def check_rights(outcome: Outcome) -> list[Finding]:
    """Judge what `trials.ask_rights` was granted."""
    if outcome.kind != "value":
        return [wrong("scheduler.error", _error(outcome), error=_error(outcome))]
    grants = {grant.name: grant for grant in (Grant(**fields) for fields in outcome.value)}
    keys = {
        "scheduler": "scheduler.bandwidth" if grants["scheduler"].remedy == GRANT_BANDWIDTH else "scheduler.rights",
        "memory lock": "memory",
        "cpu latency": "cpu latency",
    }
    return [
        fine(ROWS[key].check, grants[name].detail)
        if grants[name].granted
        else wrong(key, grants[name].detail, python=real_interpreter())
        for name, key in keys.items()
    ]


def check_kernel(release: str = platform.release(), version: str = platform.version()) -> list[Finding]:
    """Check that the kernel bounds how long it may delay a real-time process."""
    preemption = re.search(r"PREEMPT\w*(?: RT)?", version)
    found = f"{release} {preemption.group() if preemption else '(no preemption)'}"
    if preemption and preemption.group() in ("PREEMPT_RT", "PREEMPT RT"):
        return [fine("kernel", found)]
    return [wrong("kernel", found)]


def check_throttling(folder: Path = Path("/proc/sys/kernel")) -> list[Finding]:
    """Check how much of a processor real-time processes may use."""
    try:
        runtime, period = (int((folder / f"sched_rt_{name}_us").read_text()) for name in ("runtime", "period"))
    except (OSError, ValueError) as error:
        return [fine("RT throttling", f"not reported by this kernel ({error})")]
    if runtime < 0:
        return [wrong("throttling.off", "off")]
    share = runtime / period
    if share < 0.5:
        return [wrong("throttling.low", f"{100 * share:.0f} %", share=f"{100 * share:.0f} %")]
    return [fine("RT throttling", f"real-time processes may use {100 * share:.0f} %")]


def check_clock(folder: Path = Path("/sys/devices/system/clocksource/clocksource0")) -> list[Finding]:
    """Check what the kernel measures time with."""
    try:
        source = (folder / "current_clocksource").read_text().strip()
        others = (folder / "available_clocksource").read_text().split()
    except OSError as error:
        return [fine("clock source", f"not reported by this kernel ({error})")]
    found = f"{source} (available: {', '.join(others)})"
    if source in _SLOW_CLOCKS:
        return [wrong("clock", found, source=source)]
    return [fine("clock source", found)]


def check_shared_memory(
    folder: Path = Path("/dev/shm"), free_of: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free
) -> list[Finding]:
    """Check that there is shared memory, enough of it, and that it can be written."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix="bhd-doctor-") as file:
            os.posix_fallocate(file.fileno(), 0, _MIB)
        free = free_of(folder)
    except OSError as error:
        return [wrong("shm.missing", str(error), error=error.strerror or error)]
    found = f"{_size(free)} free"
    if free < _SHM_NEEDED:
        return [wrong("shm.missing", found, error=found)]
    if free < _SHM_ENOUGH:
        return [wrong("shm.small", found, free=_size(free))]
    return [fine("shared memory", found)]


def check_disk(
    root: Path,
    free_of: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Finding]:
    """Check that datasets can be written under a folder, or where it would be made: space [B], permission, speed."""
    folder = root.absolute()
    while not folder.exists():
        folder = folder.parent
    try:
        free = free_of(folder)
        if free < _DISK_NEEDED:
            return [wrong("disk.full", f"{_size(free)} free", folder=folder, free=_size(free))]
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".bhd-doctor-") as file:
            block = os.urandom(_MIB)
            start = clock()
            for _ in range(_TRIAL // _MIB):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            speed = _TRIAL / max(clock() - start, 1e-9)
    except OSError as error:
        return [wrong("disk.denied", str(folder), folder=folder, error=error.strerror or error)]
    found = f"{_size(free)} free at {folder}, {speed / 1e6:.0f} MB/s"
    findings = []
    if free < _DISK_ENOUGH:
        findings.append(wrong("disk.low", found, folder=folder, free=_size(free)))
    if speed < _DISK_SPEED:
        findings.append(wrong("disk.slow", found, folder=folder, speed=f"{speed / 1e6:.0f} MB/s"))
    return findings or [fine("disk", found)]


def check_latency(outcome: Outcome, robots: dict[str, int], timeout_s: float) -> list[Finding]:
    """Compare the latest wake-up, as one is enough to stop a robot, with rates [Hz] and the time-out [s]."""
    if outcome.kind != "value":
        return [wrong("latency.error", _error(outcome), error=_error(outcome))]
    worst = outcome.value["max"]
    findings = []
    for rate in dict.fromkeys(robots.values()):
        names, share = ", ".join(robot for robot in robots if robots[robot] == rate), worst * rate
        found = f"{names}, {rate} Hz: at worst {worst * 1e6:.0f} µs late, {100 * share:.1f} % of {1e3 / rate:g} ms"
        values = {"rate": rate, "share": f"{100 * share:.0f} %", "timeout": f"{1e3 * timeout_s:g} ms"}
        # The newest reading came a period before the tick that is late.
        if worst + 1 / rate >= timeout_s:
            findings.append(wrong("latency.stopped", found, **values))
        elif share >= LATE_SHARE:
            findings.append(wrong("latency.missed" if share >= 1 else "latency.late", found, **values))
        else:
            findings.append(fine("latency test", found))
    return findings


def _error(outcome: Outcome) -> str:
    """Return what went wrong, with the last line that a process printed before it died."""
    return f"{outcome.error} ({outcome.output})" if outcome.output and outcome.kind != "error" else outcome.error


def _size(count: int) -> str:
    return f"{count / _GIB:.1f} GiB" if count >= _GIB else f"{count / _MIB:.0f} MiB"
