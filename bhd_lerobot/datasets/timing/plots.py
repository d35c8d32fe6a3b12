"""An image of a dataset's timing: late ticks, ages of observations, inference times, intervals between frames."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.timing.report import TimingReport, quantiles
from bhd_lerobot.datasets.timing.tables import ms, ticks

# Okabe and Ito's colours, which colour-blind people can distinguish; what is late also has a mark of its own.
_LINE, _LATE, _LIMIT, _WANTED = "#0072B2", "#D55E00", "#555555", "#009E73"

# What is drawn over the frames: heading, and name of its limit.
_SERIES = {
    keys.LATENESS: ("latest control tick of a frame [ms]", "lateness"),
    keys.AGE: ("age of the observation [ms]", "age"),
    keys.INFERENCE_TIME: ("inference time [ms]", ""),
}

_POINTS = 2000  # points of a line at most; of more frames the largest of each group is drawn
_MARKS, _FEW = 500, 60  # marks at most, and so many are few


def draw_timing(report: TimingReport, path: Path) -> None:
    """Draw the timing of an episode, or of all episodes one after the other."""
    if report.simulated:
        figure = Figure(figsize=(12, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(2.1, 1))
        _draw_all_series(report, {keys.AGE: left})
        _draw_intervals(right, report)
    else:
        figure = Figure(figsize=(12, 7.4), layout="constrained")
        sides = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.1, 1))[0]
        panels = sides[0].subplots(3, 1, sharex=True)
        _draw_all_series(report, dict(zip((keys.LATENESS, keys.AGE, keys.INFERENCE_TIME), panels, strict=True)))
        histogram, numbers = sides[1].subplots(2, 1, height_ratios=(1.6, 1))
        _draw_intervals(histogram, report)
        _draw_numbers(numbers, report)
    figure.suptitle(_heading(report), fontsize=12, x=0.012, ha="left")
    figure.savefig(path, dpi=110)


def _heading(report: TimingReport) -> str:
    total = report.total.summary
    name = report.root.resolve().name
    what = f"episode {report.episodes[0].name}" if len(report.episodes) == 1 else f"{len(report.episodes)} episodes"
    clock = "wall-clock time (realtime)"
    if report.simulated:
        clock = "simulated time (lockstep), in which nothing can be late"
    return f"{name}, {what}, {total.frames} frames at {report.fps} Hz: {clock}"


def _draw_all_series(report: TimingReport, panels: dict[str, Axes]) -> None:
    columns, tolerated = report.total.columns, report.total.summary.tolerated
    late = np.flatnonzero(columns[keys.LATE])
    for key, axes in panels.items():
        label, limit = _SERIES[key]
        _draw_series(axes, columns[key], late, label=label, limit=tolerated.get(limit))
    ends = np.cumsum([len(episode.columns[keys.TIME]) for episode in report.episodes])
    if len(ends) <= _FEW:  # every other episode is shaded; narrower stripes are no help
        for start, end in zip(ends[:-1:2], ends[1::2], strict=False):
            for axes in panels.values():
                axes.axvspan(start - 0.5, end - 0.5, color="black", alpha=0.05, linewidth=0)
    list(panels.values())[-1].set_xlabel("frame" if len(ends) == 1 else "frame, all episodes one after the other")


def _draw_series(axes: Axes, values: NDArray, late: NDArray[np.intp], *, label: str, limit: float | None) -> None:
    scaled = 1e3 * np.asarray(values, np.float64)
    axes.set_title(label, fontsize=10, loc="left")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(0, max(len(scaled) - 1, 1))
    # Through all panels, so that one sees what a late frame goes together with; along the edge if they are many.
    foot, alpha = (0.0, 0.4) if len(late) <= _FEW else (0.93, 0.7)
    edge = axes.get_xaxis_transform()
    axes.vlines(late[-_MARKS:], foot, 1, transform=edge, color=_LATE, alpha=alpha, linewidth=1, zorder=1)
    axes.plot(*_thinned(scaled), color=_LINE, linewidth=1.0)
    axes.set_ylim(0, 1.12 * max(float(scaled.max(initial=0.0)), 1e3 * (limit or 0.0)) or 1.0)
    if limit is not None:
        axes.axhline(1e3 * limit, color=_LIMIT, linestyle="--", linewidth=1.0)
        axes.set_title(f"- - -  tolerated {ms(limit)} ms", fontsize=9, loc="right", color=_LIMIT)
        over = np.flatnonzero(np.asarray(values, np.float32) > np.float32(limit))
        shown = over[np.argsort(scaled[over], kind="stable")[-_MARKS:]]
        axes.plot(shown, scaled[shown], "x", color=_LATE, markersize=7, markeredgewidth=1.7, zorder=3)


def _thinned(values: NDArray) -> tuple[NDArray, NDArray]:
    """Return at most so many points that can be distinguished: of each group of frames the largest value."""
    group = -(-len(values) // _POINTS)
    if group <= 1:
        return np.arange(len(values), dtype=np.float64), values
    starts = np.arange(0, len(values), group)
    return starts + (group - 1) / 2, np.maximum.reduceat(values, starts)


def _draw_intervals(axes: Axes, report: TimingReport) -> None:
    intervals, wanted = 1e3 * report.total.intervals, 1e3 / report.fps
    axes.set_title("time between observations [ms]", fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylabel("frames, logarithmic")
    if not intervals.size:
        axes.text(0.5, 0.5, "there is only one frame", transform=axes.transAxes, ha="center", color=_LIMIT)
        return
    limits = report.total.summary.tolerated
    # A range of at least a tenth of a frame: equal to the microsecond must look equal.
    reach = 1.1 * max(float(np.abs(intervals - wanted).max()), 0.05 * wanted)
    axes.hist(intervals, bins=np.linspace(wanted - reach, wanted + reach, 62).tolist(), color=_LINE)
    axes.set_yscale("symlog", linthresh=1)  # one odd frame among thousands must be visible
    axes.set_xlim(wanted - reach, wanted + reach)
    axes.axvline(wanted, color=_WANTED, linewidth=1.5, label=f"1 / fps = {wanted:g} ms")
    if "jitter" in limits and 1e3 * limits["jitter"] < reach:
        for sign in (-1, 1):
            label = f"tolerated ± {ms(limits['jitter'])} ms" if sign > 0 else None
            axes.axvline(wanted + sign * 1e3 * limits["jitter"], color=_LIMIT, linestyle="--", linewidth=1, label=label)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2, frameon=False, fontsize=9)


def _draw_numbers(axes: Axes, report: TimingReport) -> None:
    axes.set_axis_off()
    total, frame = report.total.summary, quantiles(report.total.intervals)
    lines = (
        ("control ticks", f"{total.ticks}"),
        ("skipped ticks", f"{total.skipped}"),
        ("rate error", f"{ticks(total.rate_error)} ticks"),
        ("lateness p99", f"{ms(total.lateness_p99)} ms"),
        ("tick duration p99", f"{ms(total.duration_p99)} of {ms(total.period)} ms"),
        ("late frames", f"{total.late_frames} of {total.frames}"),
        ("lost, counted", f"{total.drops}"),
        ("frame interval", f"{ms(frame['min'])} to {ms(frame['max'])} ms"),
    )
    for row, (name, value) in enumerate(lines):
        y = 0.97 - 0.115 * row
        axes.text(0.0, y, name, transform=axes.transAxes, va="top", fontsize=9.5, color=_LIMIT)
        axes.text(0.5, y, value, transform=axes.transAxes, va="top", fontsize=9.5)
    if total.late_frames:
        axes.plot([0.02, 0.02], [0.0, 0.07], color=_LATE, alpha=0.6, linewidth=1.5)
        axes.text(0.06, 0.0, "late frame", fontsize=9.5, color=_LATE)
        axes.plot(0.515, 0.035, "x", color=_LATE, markersize=7, markeredgewidth=1.7)
        axes.text(0.55, 0.0, "over this limit", fontsize=9.5, color=_LATE)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
