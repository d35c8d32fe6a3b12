"""`bhd-doctor`: can this machine do what the package needs, and if not, what to do."""

import argparse
import json
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.apps.doctor import checks
from bhd_lerobot.apps.doctor.checks import Finding, Status
from bhd_lerobot.apps.doctor.trials import TIMEOUT_S, Outcome, run_trials
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Range, check_option
from bhd_lerobot.options.terminal import Terminal

_LEAST_POINTS = 1000  # or the 99th percentile rests on fewer than ten wake-ups
_COLOURS = {Status.OK: "green", Status.WARNING: "yellow", Status.PROBLEM: "red"}

RunTrials = Callable[[Sequence[Sequence[Any]], float], list[Outcome]]


def examine(root: Path, run: RunTrials = run_trials) -> list[Finding]:
    """Return what every check finds; datasets go to the folder."""
    rights, ffmpeg, opengl, plugins = run([["rights"], ["ffmpeg"], ["opengl"], ["plug-ins"]], TIMEOUT_S)
    versions = checks.check_versions()
    renders = not any(one.status is Status.PROBLEM and "mujoco" in one.found for one in versions)
    return [
        *checks.check_python(),
        *versions,
        *checks.check_plugins(plugins),
        *(checks.check_opengl(opengl) if renders else []),
        *checks.check_ffmpeg(ffmpeg),
        *checks.check_rights(rights),
        *checks.check_kernel(),
        *checks.check_throttling(),
        *checks.check_clock(),
        *checks.check_shared_memory(),
        *checks.check_disk(root),
    ]


def robot_rates() -> dict[str, int]:
    """Return the default control rate of each robot [Hz]."""
    from bhd_lerobot.bodies.registry import BODIES, OF_FILES

    return {name: BODIES[name]().control_hz for name in BODIES if name not in OF_FILES}


def _check_options(rate: int, seconds: float) -> None:
    """Raise a `ConfigError` if a value is out of range, or there would be too few wake-ups for a 99th percentile."""
    check_option("--rate", rate, Annotated[int, Range("[10, 10000]")])
    check_option("--seconds", seconds, Annotated[float, Range("(0, 600]")])
    if rate * seconds < _LEAST_POINTS:
        raise ConfigError(
            f"{seconds:g} s at {rate} Hz are {rate * seconds:.0f} wake-ups; a 99th percentile needs "
            f"{_LEAST_POINTS}: --seconds={_LEAST_POINTS / rate:g} or more."
        )


def _findings_table(findings: Sequence[Finding]) -> Table:
    table = Table(title="bhd-doctor", title_justify="left")
    for heading in ("check", "", "found"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        table.add_row(finding.check, f"[{_COLOURS[finding.status]}]{finding.status}[/]", escape(finding.found))
    return table


def _print_remedies(findings: Sequence[Finding], console: Console) -> None:
    """Print what is wrong in lines of whole words; a command is never broken, so that it can be copied."""
    for finding in findings:
        if finding.status is not Status.OK:
            console.print(f"\n[{_COLOURS[finding.status]}]{finding.status}: {finding.check}[/]")
            for heading, text in (("symptom", finding.symptom), ("cause", finding.cause), ("remedy", finding.remedy)):
                shown = _wrapped(f"  {heading:<8} ", text, console.width)
                console.print(shown, highlight=False, markup=False, soft_wrap=True)


def _wrapped(heading: str, text: str, width: int) -> str:
    """Return a text in lines of some width, below each other beside its heading; what is in backticks is one word."""
    joined = re.sub("`[^`]*`", lambda command: command[0].replace(" ", "\0"), text)
    lines = textwrap.wrap(
        joined, width, initial_indent=heading, subsequent_indent=" " * len(heading), break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
    return "\n".join(lines).replace("\0", " ")


def _print_latency(measured: dict[str, Any], console: Console) -> None:
    p50, p99, longest = (f"{measured[key] * 1e6:.0f} µs" for key in ("p50", "p99", "max"))
    console.print(
        f"Wake-up latency over {measured['points']} points at {measured['rate']} Hz: p50 {p50}, p99 {p99}, max "
        f"{longest}; missed {measured['missed']} points. Measured now, under the present load; not a guarantee.",
        highlight=False,
    )
    most = max(measured["histogram"])
    edges = [*(f"≤ {edge} µs" for edge in measured["bins_us"]), "later"]
    for upper, count in zip(edges, measured["histogram"], strict=True):
        # Any wake-up is visible, be it one in a million.
        bar = "█" * max(round(40 * count / most), int(count > 0))
        console.print(f"{upper:>10} {count:>8} {bar}", highlight=False)


def examine_and_print(options: argparse.Namespace, run: RunTrials) -> int:
    """Check this machine as the options ask; return the exit status."""
    if options.dataset:
        from bhd_lerobot.apps.doctor.following import describe_following

        print(describe_following(options.dataset.expanduser()))
        return 0
    root = options.root.expanduser() if options.root else None
    if root is None:
        from bhd_lerobot.datasets.format.identity import default_root

        root = default_root("bhd/doctor").parents[1]
    console, measured = Terminal(), None
    with Console(stderr=True).status("Checking this machine; half a minute …"):
        if options.realtime:
            _check_options(options.rate, options.seconds)
            # First, while nothing else continues.
            [tested] = run([["latency test", options.rate, options.seconds]], options.seconds + 60.0)
            measured = tested.value
        findings = examine(root, run)
        if options.realtime:
            from bhd_lerobot.realtime.limits import LoopLimits

            findings += checks.check_latency(tested, robot_rates(), LoopLimits().plant_timeout_s)
    if options.json:
        report = {"findings": [asdict(finding) for finding in findings], "latency_test": measured}
        print(json.dumps(report, indent=1, ensure_ascii=False))
    else:
        console.print(_findings_table(findings))
        if measured is not None:
            _print_latency(measured, console)
        _print_remedies(findings, console)
    return int(any(finding.status is Status.PROBLEM for finding in findings))
