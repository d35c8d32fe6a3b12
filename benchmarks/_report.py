"""What the benchmarks share around what they measure: options, a table of rows with goals, JSON, the exit status."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks._turns import ratios, spread, status


def parse_options(doc: str | None, arguments: Sequence[str] | None = None, **options: Any) -> argparse.Namespace:
    """Read the command line; `--json` is an option of every benchmark.

    Args:
        doc: the text of `--help`.
        arguments: of the command line; those of this process if None.
        options: by name, the default, or the default and a help, or what `argparse` takes.
    """
    parser = argparse.ArgumentParser(description=doc)
    for name, option in options.items():
        default, words = option if isinstance(option, tuple) else (option, None)
        given = option if isinstance(option, dict) else {"default": default, "type": type(default), "help": words}
        if default is False:
            given = {"action": "store_true", "help": words}
        parser.add_argument(f"--{name}", **given)
    parser.add_argument("--json", type=Path, help="write the numbers to this file as well")
    return parser.parse_args(arguments)


@dataclass(frozen=True)
class Row:
    """A number that was measured.

    Attributes:
        what: what was measured.
        value: the number, in words.
        goal: what it should be, in words; nothing if there is no goal.
        met: whether it is; None without a goal.
    """

    what: str
    value: str
    goal: str = ""
    met: bool | None = None


class Report:
    """The rows of a benchmark, and the numbers behind them.

    Attributes:
        rows: in the order that they were added.
        numbers: whatever else goes into the JSON.

    Args:
        title: above the table.
    """

    def __init__(self, title: str) -> None:
        self.title, self.rows, self.numbers = title, list[Row](), dict[str, Any]()

    def add(self, what: str, value: str, goal: str = "", *, met: bool | None = None) -> None:
        """Add a row."""
        self.rows.append(Row(what, value, goal, None if met is None else bool(met)))

    def compare(
        self,
        what: str,
        unit: str,
        speeds: Mapping[str, Sequence[float]],
        peers: Sequence[str],
        *,
        goal: float | None = None,
        form: str = ",.1f",
        name: str = "",
    ) -> None:
        """Add a row of speeds, and for each peer one of the ratio of ours, the first, to it.

        Args:
            what: what was measured.
            unit: of the speeds.
            speeds: of ours and of others, turn by turn.
            peers: those of them that ours is compared with.
            goal: the least ratio to the first of them.
            form: of the speeds.
            name: of ours in the rows of ratios; its name in `speeds` if nothing.
        """
        ours = next(iter(speeds))
        medians = {one: spread(values) for one, values in speeds.items()}
        self.add(f"{what}: {unit}", ", ".join(f"{one} {found['median']:{form}}" for one, found in medians.items()))
        self.numbers[what] = {"unit": unit, **medians}
        for peer in peers:
            self.ratio(f"{what}: {name or ours} / {peer}", ratios(speeds[ours], speeds[peer]), goal)
            goal = None

    def ratio(self, what: str, values: Sequence[float], goal: float | None = None) -> None:
        """Add a row of a ratio, measured several times, that should be at least the goal."""
        found = spread(values)
        self.numbers[what] = found
        words = "" if goal is None else f"at least {goal:g} x"
        self.add(what, times(found), words, met=None if goal is None else found["median"] >= goal)

    def end(self, path: Path | None = None) -> int:
        """Print the table, write the JSON if a file is named, and return the exit status."""
        table = Table(title=self.title, title_justify="left")
        for heading in ("measured", "", "goal", ""):
            table.add_column(heading, overflow="fold")
        for row in self.rows:
            verdict = {None: "", True: "met", False: "[bold red]MISSED[/]"}[row.met]
            table.add_row(escape(row.what), escape(row.value), escape(row.goal), verdict)
        console = Console()
        (console if console.is_terminal else Console(width=160)).print(table)
        write(path, {"rows": [asdict(row) for row in self.rows], **self.numbers})
        return status(met=all(row.met is not False for row in self.rows))


def times(found: Mapping[str, float]) -> str:
    """Return a ratio with its spread."""
    form = ".2f" if found["median"] < 2 else ".1f"
    return f"{found['median']:{form}} x ({found['low']:{form}} to {found['high']:{form}})"


def rate(estimate: Mapping[str, float | None], outcomes: Mapping[str, int]) -> str:
    """Return a rate with its interval, and how the episodes ended that were no success; a dash for one of nothing."""
    if estimate["value"] is None:
        return "–"
    text = f"{100 * estimate['value']:.1f} % ({100 * estimate['low']:.1f} to {100 * estimate['high']:.1f})"
    causes = ", ".join(f"{count} {cause}" for cause, count in outcomes.items() if cause != "success")
    return f"{text}; {causes}" if causes else text


def mean(estimate: Mapping[str, float | None], sign: str = "") -> str:
    """Return a mean, a difference (with ``sign`` "+") or a ratio, with its interval if it has one."""
    if estimate["value"] is None:
        return "–"
    if estimate["low"] is None or math.isnan(estimate["low"]):
        return f"{estimate['value']:{sign}.3f} (no interval: all values are the same, or there is one)"
    return f"{estimate['value']:{sign}.3f} ({estimate['low']:{sign}.3f} to {estimate['high']:{sign}.3f})"


def write(path: Path | None, results: Any) -> None:
    """Write results as JSON, if a file was named."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
