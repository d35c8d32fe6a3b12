"""Charts of an evaluation, as images that a page can hold in itself.

They read in greyscale and for colour-blind people: categories differ by a label, a shape or a hatch first, and only
then by a colour, from the palette of Okabe and Ito.
"""

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from bhd_lerobot.evaluation.metrics import EpisodeMetrics
from bhd_lerobot.evaluation.results import BrainSummary, PairedSummary
from bhd_lerobot.evaluation.statistics import Estimate
from bhd_lerobot.rollout.plots import BAD, GOOD, Trajectory, draw_panel

_INK, _FAINT = "#1c2733", "#9aa5b1"
# Colour and hatch of each way in which an episode ends.
OUTCOMES: dict[str, tuple[str, str]] = {
    "success": ("#dfe9f1", ""),
    "collision": ("#D55E00", "////"),
    "stuck": ("#F0E442", "...."),
    "timeout": ("#8c96a0", ""),
    "wrong_object": ("#CC79A7", "xxxx"),
    "dropped": ("#56B4E9", "\\\\\\\\"),
    "unreachable": ("#009E73", "++++"),
    "fault": ("#222222", ""),
    "estop": ("#E69F00", "oooo"),
    "failure": ("#a6611a", "||||"),
    "intervention": ("#ffffff", "----"),
}
SHOWN = 6  # episodes whose trajectories are shown
_POINTS = 400  # points of a distribution that are drawn: more would be a blot
_STYLE: Any = {
    "svg.fonttype": "none",  # text stays text: sharp, small, and found by a search
    "svg.hashsalt": "bhd-eval",
    "font.size": 10,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _FAINT,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "hatch.linewidth": 0.6,
}


def forest(brains: Mapping[str, BrainSummary], baseline: str) -> str:
    """Return success rates and mean scores, or returns, with intervals, a row a brain; dashed: the baseline's."""
    name = "score" if "score" in brains[baseline].means else "reward"
    rates = {label: _scaled(one.success, 100) for label, one in brains.items()}
    means = {label: one.means[name] for label, one in brains.items()}
    what = f"mean {'score' if name == 'score' else 'return'}"
    return _columns(
        [
            ("success rate [%]", rates, rates[baseline].value, (-3.0, 103.0)),
            (what, means, means[baseline].value, (0.0,)),
        ]
    )


def paired_forest(paired: Mapping[str, PairedSummary]) -> str:
    """Return differences from the baseline with their intervals, a row for each other brain; dashed: no difference."""
    points = {label: _scaled(one.success, 100) for label, one in paired.items()}
    columns: list[Column] = [("success rate, difference [points]", points, 0.0, (-10.0, 10.0))]
    if any(one.rewards for one in paired.values()):
        for name, title in (("reward", "return"), ("max_reward", "largest reward")):
            estimates = {label: one.rewards[name] for label, one in paired.items()}
            columns.append((f"{title}, difference", estimates, 0.0, (0.0,)))
    else:
        columns += [
            ("mean score, difference", {label: one.score for label, one in paired.items()}, 0.0, (0.0,)),
            ("mean score, ratio", {label: one.ratio for label, one in paired.items()}, 1.0, (0.0, 1.2)),
        ]
    return _columns(columns)


Column = tuple[str, dict[str, Estimate], float, tuple[float, ...]]
"""A title, estimates by brain, the number that is dashed, and numbers that the axis holds, so that a small difference
does not look like a large one."""


def _columns(columns: Sequence[Column]) -> str:
    """Return columns of estimates: a mark, its interval, and the numbers as text, in a row for each brain."""

    def draw(figure: Figure) -> None:
        for axes, (title, estimates, reference, always) in zip(
            figure.subplots(1, len(columns), sharey=True), columns, strict=True
        ):
            _draw_rows(axes, estimates, title, reference)
            low, high = axes.get_xlim()
            axes.set_xlim(min(low, *always), max(high, *always))

    return _svg(draw, (10.0, 0.9 + 0.5 * len(columns[0][1])))


def outcome_bars(brains: Mapping[str, BrainSummary]) -> str:
    """Return a stacked bar for each brain: how its episodes ended, as shares, with their numbers."""
    names = [name for name in OUTCOMES if any(name in brain.outcomes for brain in brains.values())]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        left = np.zeros(len(brains))
        for name in names:
            counts = np.array([brain.outcomes.get(name, 0) for brain in brains.values()], float)
            shares = counts / np.maximum([brain.episodes for brain in brains.values()], 1)
            colour, hatch = OUTCOMES[name]
            axes.barh(
                range(len(brains)), shares, left=left, color=colour, hatch=hatch, edgecolor=_INK, linewidth=0.6,
                height=0.62, label=name.replace("_", " "),
            )  # fmt: skip
            for row, (count, share) in enumerate(zip(counts, shares, strict=True)):
                if share > 0.03:
                    text = axes.text(left[row] + share / 2, row, f"{count:.0f}", ha="center", va="center", fontsize=9)
                    text.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 1.2, "alpha": 0.9})
            left += shares
        axes.set_yticks(range(len(brains)), list(brains))
        axes.invert_yaxis()
        axes.set_xlim(0, 1)
        axes.xaxis.set_major_formatter(lambda x, _: f"{100 * x:.0f} %")
        axes.set_xlabel("share of the episodes")
        _bare(axes)
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=6, frameon=False, fontsize=9)

    return _svg(draw, (10.0, 1.2 + 0.5 * len(brains)))


def distributions(episodes: Mapping[str, Sequence[EpisodeMetrics]], columns: Sequence[tuple[str, str]]) -> str:
    """Return how numbers spread over the episodes of each brain, by heading and name: a box, and a mark for each."""

    def draw(figure: Figure) -> None:
        for axes, (title, name) in zip(figure.subplots(1, len(columns), sharey=True), columns, strict=True):
            for row, ran in enumerate(episodes.values()):
                _draw_spread(axes, row, np.array([getattr(run, name) for run in ran], float), [o.success for o in ran])
            axes.set_yticks(range(len(episodes)), list(episodes))
            axes.set_ylim(len(episodes) - 0.4, -0.6)
            axes.set_xlabel(title)
            axes.margins(x=0.04)
            _bare(axes)

    return _svg(draw, (10.6, 0.8 + 0.72 * len(episodes)))


def trajectory_grid(trajectories: Mapping[str, Mapping[int, Trajectory]]) -> str:
    """Return trajectories from above: a row for each brain, a column for each of some episodes."""
    chosen = notable_episodes(trajectories)
    rows, columns = len(trajectories), len(chosen)
    figure = Figure(figsize=(1.9 * max(columns, 3) + 0.5, 2.15 * rows + 0.1), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for row, (label, ran) in enumerate(trajectories.items()):
        for column, number in enumerate(chosen):
            axes = grid[row][column]
            if number in ran:
                draw_panel(axes, ran[number])
            else:
                axes.set_axis_off()
        grid[row][0].set_ylabel(label, fontsize=10)
        grid[row][0].yaxis.set_visible(True)
    return _png(figure)


def notable_episodes(trajectories: Mapping[str, Mapping[int, Trajectory]], shown: int = SHOWN) -> list[int]:
    """Return the most informative episodes, in order: those that ended unlike most of a brain's, and the first ones."""
    numbers = sorted({number for ran in trajectories.values() for number in ran})
    unusual = dict.fromkeys(numbers, 0)
    for ran in trajectories.values():
        mostly = 2 * sum(run.success is True for run in ran.values()) >= len(ran)
        for number, one in ran.items():
            unusual[number] += one.success != mostly
    ranked = [n for n in sorted(numbers, key=lambda n: (-unusual[n], n)) if unusual[n]][: (shown + 1) // 2]
    return sorted([*ranked, *(n for n in numbers if n not in ranked)][:shown])


def _draw_rows(axes: Axes, estimates: Mapping[str, Estimate], title: str, reference: float) -> None:
    if math.isfinite(reference):
        axes.axvline(reference, color=_FAINT, linestyle=(0, (4, 3)), linewidth=1.2, zorder=0)
    for row, one in enumerate(estimates.values()):
        if math.isnan(one.value):
            continue
        if math.isfinite(one.low) and math.isfinite(one.high):
            axes.plot([one.low, one.high], [row, row], color=_INK, linewidth=2.2, solid_capstyle="butt")
            axes.plot([one.low, one.high], [row, row], color=_INK, linestyle="", marker="|", markersize=9)
        axes.plot(one.value, row, marker="D", color=GOOD, markeredgecolor="white", markersize=7.5)
    axes.set_yticks(range(len(estimates)), list(estimates))
    axes.set_ylim(len(estimates) - 0.5, -0.5)
    axes.set_xlabel(title)
    axes.margins(x=0.08)
    axes.locator_params(axis="x", nbins=6)
    axes.grid(axis="x", alpha=0.35)
    _bare(axes)


def _draw_spread(axes: Axes, row: int, values: np.ndarray, success: Sequence[bool]) -> None:
    """Draw one brain's values: a box, and beside each other a mark for each episode."""
    finite = np.isfinite(values)
    values, good = values[finite], np.array(success, bool)[finite]
    if not len(values):
        return
    box = axes.boxplot(
        values, positions=[row], orientation="horizontal", widths=0.34, showfliers=False, patch_artist=True,
        medianprops={"color": _INK, "linewidth": 2}, boxprops={"facecolor": "#eef2f5", "edgecolor": _FAINT},
        whiskerprops={"color": _FAINT}, capprops={"color": _FAINT}, manage_ticks=False,
    )  # fmt: skip
    box["boxes"][0].set_zorder(0)
    shown = np.arange(len(values)) if len(values) <= _POINTS else np.linspace(0, len(values) - 1, _POINTS).astype(int)
    height = row + 0.3 * (np.random.default_rng(0).random(len(values)) - 0.5)
    for mask, colour, marker in ((good, GOOD, "o"), (~good, BAD, "x")):
        picked = shown[mask[shown]]
        edge = {"linewidths": 1.0} if marker == "x" else {"linewidths": 0}
        axes.scatter(values[picked], height[picked], s=13, color=colour, marker=marker, alpha=0.55, zorder=3, **edge)


def _scaled(one: Estimate, factor: float) -> Estimate:
    return Estimate(one.value * factor, one.low * factor, one.high * factor)


def _bare(axes: Axes) -> None:
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.tick_params(left=False)


def _svg(draw: Callable[[Figure], None], size: tuple[float, float]) -> str:
    with matplotlib.rc_context(_STYLE):
        # Room between charts, so that the last number of an axis is not read with the first of the next.
        figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(wspace=0.06))
        draw(figure)
        text = io.BytesIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    return _data("image/svg+xml", text.getvalue())


def _png(figure: Figure) -> str:
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=130)
    return _data("image/png", image.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
