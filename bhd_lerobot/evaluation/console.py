"""What an evaluation tells in the terminal."""

from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.text import number, percent

if TYPE_CHECKING:
    from bhd_lerobot.evaluation.evaluate import EvalResult


def tell_summary(console: Console, config: EvalConfig, result: "EvalResult") -> None:
    """Print what was found out, and where it is."""
    results = result.results
    baseline = config.reference
    table = Table(
        title=f"{len(config.indices)} {config.split} episodes, seed {config.seed}",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    for heading in ("brain", "success, 95 %", "score, 95 %", f"success beside\n{baseline}", "failures"):
        table.add_column(escape(heading), no_wrap=True)
    for label, one in results.brains.items():
        failures = [f"{name} {count}" for name, count in one.outcomes.items() if name != "success"]
        pair = results.paired.get(label)
        table.add_row(
            escape(label) + ("\n(baseline)" if label == baseline and len(results.brains) > 1 else ""),
            _lines(f"{one.successes}/{one.episodes} = {percent(one.success)}"),
            _lines(number(one.means["score"], 3)),
            _lines(percent(pair.success, sign=True)) if pair else "",
            "\n".join(failures) or "none",
        )
    console.print(table)
    if result.estop is not None:
        console.print(f"[bold]Emergency stop ({escape(result.estop)}).[/bold] No further episode was begun.")
    if results.is_partial:
        by = f" by {result.stopped_by.name}" if result.stopped_by else ""
        console.print(f"Stopped{by}: the results are partial, and hold every episode that was finished.")
    for label in result.missed:
        low = results.brains[label].success.low
        console.print(f"[bold]{escape(label)} missed fail_below:[/bold] {low:.1%} is below {config.fail_below:.1%}.")
    console.print(f"Report: {escape(str(result.report))}", soft_wrap=True)


def _lines(text: str) -> str:
    """Return a number with its interval below it: both are read at a glance, and fit."""
    return text.replace(" (", "\n").rstrip(")")
