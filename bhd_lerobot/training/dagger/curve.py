"""The curve over the rounds of dataset aggregation, as an image."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

_POLICY, _EXPERT, _SHARE = "#1f6f8b", "#c0392b", "#8a8478"


def draw_curve(rows: Sequence[Mapping[str, Any]], expert: Mapping[str, Any], path: Path, heading: str) -> None:
    """Draw success and score of each round's policy with their 95 % intervals, and how much the expert had to drive."""
    figure = Figure(figsize=(7.5, 8.0), layout="constrained")
    figure.suptitle(heading, fontsize=11)
    axes = figure.subplots(3, 1, sharex=True)
    rounds = [row["round"] for row in rows]
    for axis, key in zip(axes, ("success", "score"), strict=False):
        values = [row[key] for row in rows]
        below = [one["value"] - one["low"] for one in values]
        above = [one["high"] - one["value"] for one in values]
        points = [one["value"] for one in values]
        axis.errorbar(rounds, points, [below, above], color=_POLICY, marker="o", capsize=3, label="policy, 95 %")
        axis.axhspan(expert[key]["low"], expert[key]["high"], color=_EXPERT, alpha=0.12, linewidth=0)
        axis.axhline(expert[key]["value"], color=_EXPERT, linestyle="--", linewidth=1.2, label="expert, 95 %")
        axis.set_ylabel(f"{key}, validation episodes")
    shares = [(row["round"], row["expert_share"]) for row in rows if row["expert_share"] is not None]
    if shares:
        axes[2].bar(*zip(*shares, strict=True), color=_SHARE, width=0.4)
    axes[2].set_ylabel("share of frames that the\nexpert drove in the recording")
    axes[2].set_xlabel("round")
    axes[2].xaxis.set_major_locator(MaxNLocator(integer=True))
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False, fontsize=9, loc="lower right")
    figure.savefig(path, dpi=110)
