"""The tables that the benchmark prints."""

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.realtime.checks import Check
from benchmarks.realtime.statistics import Block, Spread

_SIGNS = {"<=": "≤", ">=": "≥"}
_STYLES = {"met": "green", "MISSED": "bold red", "not measured": "yellow"}


def measured_table(blocks: Sequence[Block], titles: Mapping[str, str]) -> Table:
    """Return what every case measured: medians over its blocks, sums of what is counted, the overall maximum.

    Args:
        blocks: all blocks of the run.
        titles: what to call the cases, in the order of the rows.
    """
    table = Table(title="Measured, µs: medians of the blocks", title_justify="left")
    table.add_column("loop")
    table.add_column("while")
    for heading in ("wake p50", "p99", "p99.9", "max", "tick p50", "p99", "ticks", "late", "skipped"):
        table.add_column(heading, justify="right", no_wrap=True)
    for condition in dict.fromkeys(b.condition for b in blocks):
        for case, title in titles.items():
            mine = [b for b in blocks if b.case == case and b.condition == condition]
            if not mine:
                continue
            table.add_row(
                escape(title),
                condition,
                *(f"{_median(mine, value):.1f}" for value in ("wake_p50", "wake_p99", "wake_p999")),
                f"{max(b.wake_max for b in mine):.0f}",
                *(
                    "" if any(getattr(b, value) is None for b in mine) else f"{_median(mine, value):.1f}"
                    for value in ("tick_p50", "tick_p99")
                ),
                *(str(sum(getattr(b, value) for b in mine)) for value in ("ticks", "late", "skipped")),
            )
    return table


def verdict_table(checks: Sequence[Check]) -> Table:
    """Return the checks with their measured values, bounds and verdicts."""
    table = Table(title="Verdicts: medians of the ratios of paired blocks", title_justify="left")
    table.add_column("check")
    table.add_column("while")
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("bound", justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("")
    for check in checks:
        style = _STYLES[check.verdict]
        table.add_row(
            escape(check.name),
            escape(check.condition),
            "" if check.measured is None else f"{check.measured:.2f}",
            f"{_SIGNS[check.relation]} {check.bound:g}",
            f"[{style}]{check.verdict}[/{style}]",
            escape(check.reason or check.detail),
        )
    return table


def console() -> Console:
    """Return a console that is wide enough for the tables, also where the output is a file."""
    wide = Console()
    return wide if wide.is_terminal else Console(width=150)


def _median(blocks: Sequence[Block], value: str) -> float:
    return Spread.of([getattr(b, value) for b in blocks]).median
