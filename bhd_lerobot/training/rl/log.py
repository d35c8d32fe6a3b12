"""What a reinforcement learning run shows: progress, and the learning curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

PLOT_NAME = "learning_curve.png"
Row = dict[str, Any]

_CURVES = (("return", "return of the task"), ("success", "success"), ("score", "score"))
_SHOWN = (
    ("return", "return"),
    ("success", "success"),
    ("score", "score"),
    ("val_success", "validation success"),
    ("val_score", "validation score"),
    ("kl", "kl"),
    ("std", "std"),
    ("frames_per_s", "frames/s"),
)


def draw_curve(rows: Sequence[Row], path: Path, heading: str, rule: tuple[str, Mapping[str, float]] | None) -> None:
    """Draw return, success and score over environment steps and over minutes.

    Args:
        rows: rows of a metrics file.
        path: where the image goes.
        heading: what stands above it.
        rule: name and level of the rule on the validation episodes, by the keys `val_return` and so on.
    """
    figure = Figure(figsize=(11, 8.4), layout="constrained")
    figure.suptitle(heading, fontsize=11)
    axes = figure.subplots(len(_CURVES), 2, sharey="row", sharex="col", squeeze=False)
    for line, (key, label) in zip(axes, _CURVES, strict=True):
        for axis, time in zip(line, ("step", "minutes"), strict=True):
            training = _points(rows, time, key)
            if training:
                axis.plot(*training, color="#8a8478", linewidth=1.0, alpha=0.8, label="training, with exploration")
            judged = _points(rows, time, f"val_{key}")
            if judged:
                axis.plot(
                    *judged, color="#1f6f8b", marker="o", markersize=4, linewidth=1.6, label="validation episodes"
                )
            if rule is not None:
                axis.axhline(rule[1][f"val_{key}"], color="#c0392b", linestyle="--", linewidth=1.2, label=rule[0])
            axis.grid(alpha=0.3)
        line[0].set_ylabel(label)
    axes[-1][0].set_xlabel("environment steps")
    axes[-1][1].set_xlabel("minutes")
    axes[0][0].legend(frameon=False, fontsize=9)
    axes[0][0].xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M" if value >= 1e5 else f"{value:g}")
    figure.savefig(path, dpi=110)


def _points(rows: Sequence[Row], time: str, key: str) -> tuple[list[float], list[float]] | None:
    points = [(row[time], row[key]) for row in rows if row.get(key) is not None]
    return ([x for x, _ in points], [y for _, y in points]) if points else None


class RlProgress:
    """A bar in a terminal, a line for each logged update elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:.0f}%"),
            TextColumn("{task.fields[numbers]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> "RlProgress":
        self._bar.start()
        self._task = self._bar.add_task("learning", total=1.0, numbers="")
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def show(self, row: Row, done: float) -> None:
        """Show a row, and how much of the run is done, from 0 to 1."""
        numbers = "  ".join(f"{label} {row[key]:.4g}" for key, label in _SHOWN if row.get(key) is not None)
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, numbers=numbers)
        elif "val_score" in row:
            self._console.print(f"step {row['step']:,}  {row['minutes']:.1f} min  {numbers}")
