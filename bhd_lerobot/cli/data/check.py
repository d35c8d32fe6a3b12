"""What `bhd-data check` prints, and which limits it knows."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.summary import is_being_written
from bhd_lerobot.datasets.recovery.fix import fix
from bhd_lerobot.datasets.validate.dataset import CHECKS, DatasetCheck, Severity, check_dataset
from bhd_lerobot.datasets.validate.values import Limits
from bhd_lerobot.errors import DatasetLockedError, counted
from bhd_lerobot.options.terminal import Terminal

# No option of a robot changes its limits, and its configuration takes seconds to import.
_COLOURS = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.NOTE: "dim"}


def add_to(commands: Commands) -> None:
    """Add `check`."""
    help_text = "validate a dataset; exit status 0 if it is valid, 1 if not; changes nothing without --fix"
    command = add_command(commands, "check", help_text, _run)
    command.add_argument("--json", action="store_true", help="print everything as JSON")
    command.add_argument("--strict", action="store_true", help="exit with status 1 for warnings, too")
    command.add_argument("--no-videos", action="store_true", help="do not check the videos, which takes longest")
    command.add_argument("--fix", action="store_true", help="correct wrong statistics and counts, and check again")


def _run(options: argparse.Namespace) -> int:
    root, videos = root_of(options), not options.no_videos
    if options.fix:
        for line in fix(root, check_dataset(root, limits_of, videos=videos).findings):
            print(f"fixed {line}", file=sys.stderr if options.json else sys.stdout)
    return check(root, Terminal(), as_json=options.json, is_strict=options.strict, videos=videos)


def check(root: Path, console: Console, *, as_json: bool, is_strict: bool, videos: bool) -> int:
    """Check a dataset and print what was found; return 0 if it is valid and 1 if it is not."""
    if is_being_written(root):
        raise DatasetLockedError(
            f"{root} is being recorded or changed at this moment and cannot be checked. Check it again when that has "
            "ended."
        )
    found = check_dataset(root, limits_of, videos=videos)
    is_valid = found.worst < (Severity.WARNING if is_strict else Severity.ERROR)
    if as_json:
        print(json.dumps(_plain(found, is_valid), indent=1))
    else:
        _print(found, console, is_valid)
    return 0 if is_valid else 1


def limits_of(robot_type: str | None) -> Limits:
    """Return what a known robot keeps to: the ranges of its joints, or the largest speeds of a base."""
    body = body_of(robot_type)
    if body is None:
        return {}
    ranges = dict(zip(body.limits.names, zip(*body.limits.bounds, strict=True), strict=True))
    # What a base measures, slip and all, may be a little more than its command.
    return {keys.APPLIED_ACTION: ranges, **({keys.OBSERVATION_STATE: ranges} if body.arm else {})}


def _print(found: DatasetCheck, console: Console, is_valid: bool) -> None:
    if found.findings:
        table = Table(title=escape(str(found.root)), title_justify="left")
        for heading in ("", "check", "where", "what"):
            table.add_column(heading, overflow="fold")
        for finding in found.findings:
            colour = _COLOURS[finding.severity]
            what = escape(finding.what + (f". {finding.remedy}" if finding.remedy else ""))
            table.add_row(f"[{colour}]{finding.severity.word}[/]", finding.check, escape(finding.where), what)
        console.print(table)
    errors, warnings = found.count(Severity.ERROR), found.count(Severity.WARNING)
    console.print(
        f"{escape(str(found.root))}: {counted(found.episodes, 'episode')}, {counted(found.frames, 'frame')}: "
        f"{'valid' if is_valid else 'not valid'}, {_some(errors, 'error')}, {_some(warnings, 'warning')}.",
        soft_wrap=True,
        highlight=False,
    )


def _some(count: int, name: str) -> str:
    return f"{count or 'no'} {name}{'' if count == 1 else 's'}"


def _plain(found: DatasetCheck, is_valid: bool) -> dict[str, object]:
    return {
        "root": str(found.root),
        "valid": is_valid,
        "episodes": found.episodes,
        "frames": found.frames,
        "checks": list(CHECKS),
        "findings": [{**asdict(finding), "severity": finding.severity.word} for finding in found.findings],
    }
