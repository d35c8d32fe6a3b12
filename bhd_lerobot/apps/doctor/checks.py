"""The doctor's checks. Each looks at one thing and returns findings; where it looks can be given, for tests."""

import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

# LeRobot requires it, so it is there; its absence would be a finding of its own.
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from bhd_lerobot.apps.doctor.child import Outcome
from bhd_lerobot.apps.doctor.findings import COMPLAINTS, Finding, complain, fine
from bhd_lerobot.apps.doctor.latency_test import WakeUps
from bhd_lerobot.realtime.privileges import GRANT_BANDWIDTH, Grant, real_interpreter

DISTRIBUTION = "lerobot_robot_bhd"
ROBOTS = ("turtlebot3", "ur5")
TELEOPERATORS = ("bhd_brain",)

# Of the period, for the wake-up's p99. What is lost to waiting is lost to the tick, and it is jitter: speeds that are
# differences over one period are wrong by as much. Beyond a half, a tick of a quarter of the period has no reserve.
FINE_SHARE, LATE_SHARE = 0.10, 0.50

_SLOW_CLOCKS = ("hpet", "acpi_pm", "pit", "jiffies", "refined-jiffies")
_MIB, _GIB = 2**20, 2**30
_SHM_NEEDED = 16 * _MIB  # the blocks of some robots
_SHM_ENOUGH = 128 * _MIB  # a container has 64 MiB by default, too little for the workers of a data loader
_DISK_NEEDED, _DISK_ENOUGH = _GIB, 10 * _GIB
_DISK_SPEED = 20e6  # [B/s]
_TRIAL = 32 * _MIB


def check_python(version: str = platform.python_version()) -> list[Finding]:
    """Check that Python is one of those that the package asks for."""
    try:
        asked = metadata.metadata(DISTRIBUTION)["Requires-Python"]
    except metadata.PackageNotFoundError:
        return [complain("package.missing", "not installed", name=DISTRIBUTION)]
    if not SpecifierSet(asked).contains(version, prereleases=True):
        return [complain("python", version, version=version, asked=asked)]
    return [fine("Python", f"{version} at {real_interpreter()}")]


def check_versions(
    shown: Sequence[str] = ("lerobot", "mujoco"), version_of: Callable[[str], str] = metadata.version
) -> list[Finding]:
    """Check that packages have the versions that ours asks for.

    What it always needs must be there; what only an extra of it needs, and happens to be there, is compared as well.

    Args:
        shown: the packages that get a finding also if all is well.
        version_of: returns the version of an installed package.
    """
    try:
        extras = metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or []
        asked = {extra: _requirements(extra) for extra in ("", *extras)}
    except metadata.PackageNotFoundError:
        return [complain("package.missing", "not installed", name=DISTRIBUTION)]
    findings = []
    for name, wanted in asked[""].items():
        try:
            version = version_of(name)
        except metadata.PackageNotFoundError:
            findings.append(complain("package.missing", f"{name} is not installed", name=name))
            continue
        if not wanted.contains(version, prereleases=True):
            values = {"name": name, "version": version, "asked": wanted}
            findings.append(complain("package.version", f"{name} {version}", **values))
        elif name in shown:
            findings.append(fine("versions", f"{name} {version}, asked for is {wanted}"))
    return findings + _check_extras({extra: asked[extra] for extra in extras}, asked[""], version_of)


def _requirements(extra: str) -> dict[str, SpecifierSet]:
    """Return which versions of which packages ours asks for on this machine: always, or with an extra of it.

    A package may be named several times, as for an extra of its own; all of that holds at once.
    """
    asked: dict[str, SpecifierSet] = {}
    for one in map(Requirement, metadata.requires(DISTRIBUTION) or []):
        if one.marker is None or one.marker.evaluate({"extra": extra}):
            name = canonicalize_name(one.name)
            asked[name] = asked.get(name, SpecifierSet()) & one.specifier
    return asked


def _check_extras(
    asked: dict[str, dict[str, SpecifierSet]], always: dict[str, SpecifierSet], version_of: Callable[[str], str]
) -> list[Finding]:
    wanted: dict[tuple[str, SpecifierSet], list[str]] = {}
    for extra, packages in asked.items():
        for name, versions in packages.items():
            if versions != always.get(name):
                wanted.setdefault((name, versions), []).append(extra)
    findings = []
    for (name, versions), extras in wanted.items():
        try:
            version = version_of(name)
        except metadata.PackageNotFoundError:
            continue  # nobody says which extras were asked for
        known = not always.get(name, SpecifierSet()).contains(version, prereleases=True)  # a problem of its own
        if not known and not versions.contains(version, prereleases=True):
            values = {"name": name, "version": version, "asked": versions, "extra": ",".join(extras)}
            findings.append(complain("package.extra", f"{name} {version}", **values))
    return findings


def check_plugins(outcome: Outcome) -> list[Finding]:
    """Judge what `doctor_child.list_plugins` found."""
    if outcome.kind != "value":
        return [complain("plugins.error", "LeRobot cannot be imported", error=_error(outcome))]
    known = outcome.value
    missing = [f"the robot {name}" for name in ROBOTS if name not in known["robots"]]
    missing += [f"the teleoperator {name}" for name in TELEOPERATORS if name not in known["teleoperators"]]
    if missing:
        return [complain("plugins.missing", outcome.output, missing=", ".join(missing), error=outcome.output)]
    return [fine("plug-ins", f"LeRobot knows {', '.join((*ROBOTS, *TELEOPERATORS))}")]


def check_opengl(outcome: Outcome) -> list[Finding]:
    """Judge what became of `doctor_child.render`."""
    if outcome.kind in ("crash", "timeout"):
        return [complain("opengl.crash", outcome.error, error=_error(outcome))]
    if outcome.kind == "error":
        return [complain("opengl.missing", "no image", error=outcome.error)]
    driver = outcome.value["driver"]
    if outcome.value["spread"] == 0:
        return [complain("opengl.blank", driver, driver=driver)]
    return [fine("OpenGL", driver)]


def check_ffmpeg(outcome: Outcome) -> list[Finding]:
    """Judge what became of `doctor_child.encode`."""
    if outcome.kind != "value" or outcome.value["bytes"] == 0:
        return [complain("ffmpeg", "no video", error=_error(outcome) or "it wrote nothing")]
    found = outcome.value
    shared = "there, too" if found["shared"] else "not there, LeRobot uses PyAV"
    return [
        fine("FFmpeg", f"PyAV {found['pyav']}, libavcodec {found['libavcodec']}; libraries for torchcodec: {shared}")
    ]


def check_rights(outcome: Outcome) -> list[Finding]:
    """Judge what `doctor_child.ask_rights` was granted."""
    if outcome.kind != "value":
        return [complain("scheduler.error", _error(outcome), error=_error(outcome))]
    grants = {grant.name: grant for grant in (Grant(**fields) for fields in outcome.value)}
    keys = {
        "scheduler": "scheduler.bandwidth" if grants["scheduler"].remedy == GRANT_BANDWIDTH else "scheduler.rights",
        "memory lock": "memory",
        "cpu latency": "latency",
    }
    return [
        fine(COMPLAINTS[key].check, grants[name].detail)
        if grants[name].granted
        else complain(key, grants[name].detail, python=real_interpreter())
        for name, key in keys.items()
    ]


def check_kernel(release: str = platform.release(), version: str = platform.version()) -> list[Finding]:
    """Check that the kernel bounds how long it may delay a real-time process."""
    preemption = re.search(r"PREEMPT\w*(?: RT)?", version)
    found = f"{release} {preemption.group() if preemption else '(no preemption)'}"
    if preemption and preemption.group() in ("PREEMPT_RT", "PREEMPT RT"):
        return [fine("kernel", found)]
    return [complain("kernel", found)]


def check_throttling(folder: Path = Path("/proc/sys/kernel")) -> list[Finding]:
    """Check how much of a processor real-time processes may use."""
    try:
        runtime, period = (int((folder / f"sched_rt_{name}_us").read_text()) for name in ("runtime", "period"))
    except (OSError, ValueError) as error:
        return [fine("RT throttling", f"this kernel tells nothing ({error})")]
    if runtime < 0:
        return [complain("throttling.off", "off")]
    share = runtime / period
    if share < 0.5:
        return [complain("throttling.low", f"{share:.0%}", share=f"{share:.0%}")]
    return [fine("RT throttling", f"real-time processes may use {share:.0%}")]


def check_clock(folder: Path = Path("/sys/devices/system/clocksource/clocksource0")) -> list[Finding]:
    """Check what the kernel measures time with."""
    try:
        source = (folder / "current_clocksource").read_text().strip()
        others = (folder / "available_clocksource").read_text().split()
    except OSError as error:
        return [fine("clock source", f"this kernel tells nothing ({error})")]
    found = f"{source} (available: {', '.join(others)})"
    if source in _SLOW_CLOCKS:
        return [complain("clock", found, source=source)]
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
        return [complain("shm.missing", str(error), error=error.strerror or error)]
    found = f"{_size(free)} free"
    if free < _SHM_NEEDED:
        return [complain("shm.missing", found, error=found)]
    if free < _SHM_ENOUGH:
        return [complain("shm.small", found, free=_size(free))]
    return [fine("shared memory", found)]


def check_disk(
    root: Path,
    free_of: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Finding]:
    """Check that datasets can be written under a folder, or where it would be made: space, permission, speed.

    Args:
        root: the folder.
        free_of: free space of a folder's disk [B].
        clock: the time [s].
    """
    folder = root.absolute()
    while not folder.exists():
        folder = folder.parent
    try:
        free = free_of(folder)
        if free < _DISK_NEEDED:
            return [complain("disk.full", f"{_size(free)} free", folder=folder, free=_size(free))]
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".bhd-doctor-") as file:
            block = os.urandom(_MIB)
            start = clock()
            for _ in range(_TRIAL // _MIB):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            speed = _TRIAL / max(clock() - start, 1e-9)
    except OSError as error:
        return [complain("disk.denied", str(folder), folder=folder, error=error.strerror or error)]
    found = f"{_size(free)} free at {folder}, {speed / 1e6:.0f} MB/s"
    findings = []
    if free < _DISK_ENOUGH:
        findings.append(complain("disk.low", found, folder=folder, free=_size(free)))
    if speed < _DISK_SPEED:
        findings.append(complain("disk.slow", found, folder=folder, speed=f"{speed / 1e6:.0f} MB/s"))
    return findings or [fine("disk", found)]


def check_wakeups(outcome: Outcome, robots: dict[str, int]) -> list[Finding]:
    """Compare a measurement with what robots need.

    Args:
        outcome: what became of `wakeup.measure`.
        robots: control rate of each [Hz].
    """
    if outcome.kind != "value":
        return [complain("wakeup.error", _error(outcome), error=_error(outcome))]
    measured: WakeUps = outcome.value[0]
    findings = []
    for robot, rate in robots.items():
        share = measured.p99 * rate
        found = f"{robot}, {rate} Hz: p99 {measured.p99 * 1e6:.0f} µs is {share:.1%} of {1e3 / rate:g} ms"
        if share < FINE_SHARE:
            findings.append(fine("wake-up", found))
        else:
            key = "wakeup.late" if share < LATE_SHARE else "wakeup.missed"
            findings.append(complain(key, found, rate=rate, share=f"{share:.0%}"))
    return findings


def _error(outcome: Outcome) -> str:
    """Return what went wrong, with the last line that a process printed before it died."""
    return f"{outcome.error} ({outcome.output})" if outcome.output and outcome.kind != "error" else outcome.error


def _size(count: int) -> str:
    return f"{count / _GIB:.1f} GiB" if count >= _GIB else f"{count / _MIB:.0f} MiB"
