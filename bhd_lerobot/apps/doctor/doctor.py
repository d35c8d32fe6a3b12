"""`bhd-doctor`: can this machine do what the package needs, and if not, what is to be done."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.apps.doctor import checks, child
from bhd_lerobot.apps.doctor.findings import Finding, Status
from bhd_lerobot.apps.doctor.latency_test import BINS_US, WakeUps, measure
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.realtime.privileges import RealtimeSettings

_LEAST_POINTS = 1000  # or the 99th percentile rests on fewer than ten wake-ups
_COLOURS = {Status.OK: "green", Status.WARNING: "yellow", Status.PROBLEM: "red"}

RunChild = Callable[..., child.Outcome]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bhd-doctor",
        description="Check this machine; print symptom, cause and remedy of what is wrong. Exit status 1: a problem.",
    )
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    parser.add_argument("--root", type=Path, help="folder for datasets, whose disk is checked; LeRobot's by default")
    parser.add_argument("--realtime", action="store_true", help="measure how late a real-time process wakes up, too")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the measurement [s] (default: 10)")
    parser.add_argument("--rate", type=int, default=1000, help="wake-ups a second [Hz] (default: 1000)")
    return parser


def examine(root: Path, run_child: RunChild = child.run_child) -> Iterator[Finding]:
    """Yield what every check finds, one check after the other, so that none disturbs another.

    Args:
        root: folder for datasets.
        run_child: how to try something out in a process of its own.
    """
    yield from checks.check_python()
    yield from checks.check_versions()
    yield from checks.check_plugins(run_child(child.list_plugins))
    yield from checks.check_opengl(run_child(child.render, timeout_s=60.0))
    yield from checks.check_ffmpeg(run_child(child.encode, timeout_s=60.0))
    yield from checks.check_rights(run_child(child.ask_rights, RealtimeSettings(), timeout_s=60.0))
    yield from checks.check_kernel()
    yield from checks.check_throttling()
    yield from checks.check_clock()
    yield from checks.check_shared_memory()
    yield from checks.check_disk(root)


def robot_rates() -> dict[str, int]:
    """Return the default control rate of each robot [Hz]."""
    from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
    from bhd_lerobot.bodies.ur5 import ur5

    return {"turtlebot3": turtlebot3_burger().control_hz, "ur5": ur5().control_hz}


def measure_wakeups(rate: int, seconds: float, run_child: RunChild = child.run_child) -> child.Outcome:
    """Measure in a spawned process how late a real-time process wakes up.

    Args:
        rate: wake-ups a second [Hz].
        seconds: length of the measurement [s].
        run_child: how to run it in a process of its own.

    Returns:
        Its value, if it has one, is a `WakeUps` and the list of grants.

    Raises:
        ConfigError: a value is out of range, or there would be too few wake-ups to tell a 99th percentile.
    """
    if not 10 <= rate <= 10_000:
        raise ConfigError(f"--rate is {rate} Hz; it must be from 10 to 10000.")
    if not 0 < seconds <= 600:
        raise ConfigError(f"--seconds is {seconds:g}; it must be above 0 and at most 600.")
    if rate * seconds < _LEAST_POINTS:
        raise ConfigError(
            f"{seconds:g} s at {rate} Hz are {rate * seconds:.0f} wake-ups; a 99th percentile needs "
            f"{_LEAST_POINTS}: --seconds={_LEAST_POINTS / rate:g} or more."
        )
    return run_child(measure, RealtimeSettings(), rate, seconds, timeout_s=seconds + 60.0)


def _findings_table(findings: Sequence[Finding]) -> Table:
    table = Table(title="bhd-doctor", title_justify="left")
    for heading in ("check", "", "found"):
        table.add_column(heading, overflow="fold")
    for one in findings:
        table.add_row(one.check, f"[{_COLOURS[one.status]}]{one.status}[/]", escape(one.found))
    return table


def _print_complaints(findings: Sequence[Finding], console: Console) -> None:
    """Print what is wrong as lines that are not broken, so that a command can be copied from them."""
    for one in findings:
        if one.status is not Status.OK:
            console.print(f"\n[{_COLOURS[one.status]}]{one.status}: {one.check}[/]")
            for heading, text in (("symptom", one.symptom), ("cause", one.cause), ("remedy", one.remedy)):
                console.print(f"  {heading:<8} {escape(text)}", highlight=False, soft_wrap=True)


def _print_wakeups(wakeups: WakeUps, console: Console) -> None:
    console.print(
        f"Wake-up latency over {wakeups.points} points at {wakeups.rate} Hz: p50 {wakeups.p50 * 1e6:.0f} µs, "
        f"p99 {wakeups.p99 * 1e6:.0f} µs, max {wakeups.max * 1e6:.0f} µs; missed {wakeups.missed} points. "
        "Measured now, on this load; no promise.",
        highlight=False,
    )
    most = max(wakeups.histogram)
    for upper, count in zip([*(f"≤ {edge} µs" for edge in BINS_US), "later"], wakeups.histogram, strict=True):
        # Any wake-up is to be seen, be it one in a million.
        bar = "█" * max(round(40 * count / most), int(count > 0))
        console.print(f"{upper:>10} {count:>8} {bar}", highlight=False)


def main(arguments: Sequence[str] | None = None, run_child: RunChild = child.run_child) -> int:
    """Run `bhd-doctor`; return the exit status: 0, 1 if there is a problem, 2 for wrong options."""
    options = _parser().parse_args(arguments)
    root = options.root.expanduser() if options.root else None
    if root is None:
        from bhd_lerobot.datasets.format.identity import default_root

        root = default_root("bhd/doctor").parents[1]
    console = Console()
    wakeups: dict[str, Any] | None = None
    try:
        with Console(stderr=True).status("Looking at this machine; half a minute …"):
            # First, while nothing else goes on.
            outcome = measure_wakeups(options.rate, options.seconds, run_child) if options.realtime else None
            findings = list(examine(root, run_child))
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if outcome is not None:
        findings += checks.check_wakeups(outcome, robot_rates())
        if outcome.kind == "value":
            wakeups = {**asdict(outcome.value[0]), "bins_us": BINS_US, "grants": outcome.value[1]}
    if options.json:
        report = {"findings": [one.as_dict() for one in findings], "wakeups": wakeups}
        print(json.dumps(report, indent=1, ensure_ascii=False))
    else:
        console.print(_findings_table(findings))
        if outcome is not None and outcome.kind == "value":
            _print_wakeups(outcome.value[0], console)
        _print_complaints(findings, console)
    return int(any(one.status is Status.PROBLEM for one in findings))


if __name__ == "__main__":
    sys.exit(main())
