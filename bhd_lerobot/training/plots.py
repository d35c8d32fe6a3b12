"""The curves of training runs, as images."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from bhd_lerobot.training.log import Row

RECENT = 100  # least episodes that a point of a learning curve stands for, if so many have ended
_INK, _BLUE, _RED, _GREY = "#2c3e50", "#1f6f8b", "#c0392b", "#8a8478"
_PARTS = ("#2980b9", "#8e9a3b", "#8e44ad", "#d68910")


def draw_loss(rows: Sequence[Row], path: Path, heading: str, loss: str) -> None:
    """Draw training and held-out loss over the steps, and below them the learning rate; `loss` names the y-axis."""
    figure = Figure(figsize=(8.5, 5.2))
    # A layout engine takes as long again.
    figure.subplots_adjust(left=0.1, right=0.98, top=0.92, bottom=0.1, hspace=0.13)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    smallest = []
    for key, label, colour, marker in (
        *((key, f"training, {key}", colour, "") for key, colour in zip(_parts(rows), _PARTS, strict=False)),
        ("loss", "training, mean since the previous point", _INK, ""),
        ("held_out_loss", "held-out episodes, not trained on", _RED, "o"),
    ):
        if points := _points(rows, key):
            step, value = points[-1]
            above.plot(
                *zip(*points, strict=True),
                color=colour,
                marker="o" if len(points) == 1 else marker,
                markersize=3.5,
                linewidth=1.3,
                label=f"{label}: {value:.3g} at step {step:,}",
            )
            smallest.append(min(value for _, value in points))
    if smallest and min(smallest) > 0:  # a negative log-likelihood may be below 0
        above.set_yscale("log")
        above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        above.yaxis.set_minor_locator(NullLocator())
        above.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        loss += ", log scale"
    above.set_ylabel(loss)
    if smallest:
        above.legend(frameon=False, fontsize=9)
    if rates := _points(rows, "lr"):
        below.plot(*zip(*rates, strict=True), color=_GREY, linewidth=1.2)
    below.set_ylim(bottom=0)
    below.set_ylabel("learning\nrate")
    below.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    below.set_xlabel("training step")
    below.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    _save(figure, (above, below), path, heading)


def draw_learning(rows: Sequence[Row], path: Path, heading: str, rule: tuple[str, Mapping[str, float]] | None) -> None:
    """Draw return, success and score of reinforcement learning over environment steps."""
    figure = Figure(figsize=(8.5, 8.4), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    keys = {"return": "return of the task", "success": "success", "score": "score"}
    for axis, (key, label) in zip(axes, keys.items(), strict=True):
        if training := recent(rows, key):
            name = f"training, with exploration: last {RECENT} episodes or more"
            axis.plot(*training, color=_GREY, linewidth=1.0, alpha=0.8, label=name)
        if judged := _points(rows, f"val_{key}"):
            points = zip(*judged, strict=True)
            axis.plot(*points, color=_BLUE, marker="o", markersize=4, linewidth=1.6, label="validation episodes")
        if rule is not None:
            axis.axhline(rule[1][f"val_{key}"], color=_RED, linestyle="--", linewidth=1.2, label=rule[0])
        axis.set_ylabel(label)
    axes[-1].set_xlabel("environment steps")
    axes[0].legend(frameon=False, fontsize=9)
    axes[0].xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M" if value >= 1e5 else f"{value:g}")
    _save(figure, axes, path, heading)


def draw_rounds(rows: Sequence[Mapping[str, Any]], expert: Mapping[str, Any], path: Path, heading: str) -> None:
    """Draw success and score of each round's policy with their 95 % intervals, and how much the expert had to drive."""
    figure = Figure(figsize=(7.5, 8.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    rounds = [row["round"] for row in rows]
    for axis, key in zip(axes, ("success", "score"), strict=False):
        values = [row[key] for row in rows]
        reach = [[one["value"] - one["low"] for one in values], [one["high"] - one["value"] for one in values]]
        points = [one["value"] for one in values]
        axis.errorbar(rounds, points, reach, color=_BLUE, marker="o", capsize=3, label="policy, 95 %")
        axis.axhspan(expert[key]["low"], expert[key]["high"], color=_RED, alpha=0.12, linewidth=0)
        axis.axhline(expert[key]["value"], color=_RED, linestyle="--", linewidth=1.2, label="expert, 95 %")
        axis.set_ylabel(f"{key}, validation episodes")
    if shares := [(row["round"], row["expert_share"]) for row in rows if row["expert_share"] is not None]:
        axes[2].bar(*zip(*shares, strict=True), color=_GREY, width=0.4)
    axes[2].set_ylabel("share of frames that the\nexpert drove in the recording")
    axes[2].set_xlabel("round")
    axes[2].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].legend(frameon=False, fontsize=9, loc="lower right")
    _save(figure, axes, path, heading)


def _save(figure: Figure, axes: Iterable[Axes], path: Path, heading: str) -> None:
    figure.suptitle(heading, fontsize=11)
    for axis in axes:
        axis.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)


def _points(rows: Sequence[Row], key: str) -> list[tuple[int, float]]:
    return [(row["step"], row[key]) for row in rows if row.get(key) is not None]


def _parts(rows: Sequence[Row]) -> list[str]:
    """Return the keys of what a loss is the sum of, if the policy says so; a held-out loss may be one of them only."""
    keys = [key for key in (rows[0] if rows else {}) if key.endswith("_loss") and key != "held_out_loss"]
    return keys if len(keys) > 1 else []


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
