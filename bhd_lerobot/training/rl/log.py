"""What a reinforcement learning run shows: progress, and the learning curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

PLOT_NAME = "learning_curve.png"
Row = dict[str, Any]

RECENT = 100  # least episodes that a point of training stands for, if so many have ended
_CURVES = (("return", "return of the task"), ("success", "success"), ("score", "score"))
SHOWN = (
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
    """Draw return, success and score over environment steps."""
    figure = Figure(figsize=(8.5, 8.4), layout="constrained")
    figure.suptitle(heading, fontsize=11)
    axes = figure.subplots(len(_CURVES), 1, sharex=True)
    for axis, (key, label) in zip(axes, _CURVES, strict=True):
        if training := recent(rows, key):
            name = f"training, with exploration: last {RECENT} episodes or more"
            axis.plot(*training, color="#8a8478", linewidth=1.0, alpha=0.8, label=name)
        judged = [(row["step"], row[f"val_{key}"]) for row in rows if row.get(f"val_{key}") is not None]
        if judged:
            points = zip(*judged, strict=True)
            axis.plot(*points, color="#1f6f8b", marker="o", markersize=4, linewidth=1.6, label="validation episodes")
        if rule is not None:
            axis.axhline(rule[1][f"val_{key}"], color="#c0392b", linestyle="--", linewidth=1.2, label=rule[0])
        axis.grid(alpha=0.3)
        axis.set_ylabel(label)
    axes[-1].set_xlabel("environment steps")
    axes[0].legend(frameon=False, fontsize=9)
    axes[0].xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M" if value >= 1e5 else f"{value:g}")
    figure.savefig(path, dpi=110)


def recent(rows: Sequence[Row], key: str) -> tuple[list[float], list[float]] | None:
    """Return the points of a curve of training: steps, and means over the last episodes that had ended by then.

    In one update few episodes end, and those that end between the others' are the failures.
    """
    ended = [(row["step"], row["episodes"], row[key]) for row in rows if row.get(key) is not None]
    values = []
    for last in range(len(ended)):
        first, count = last, ended[last][1]
        while first and count < RECENT:
            first -= 1
            count += ended[first][1]
        values.append(sum(number * value for _, number, value in ended[first : last + 1]) / count)
    return ([when for when, *_ in ended], values) if ended else None
