"""The timing of a dataset as tables for a terminal."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.control.timing import TimingSummary
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.timing.report import SIMULATED, EpisodeTiming, TimingReport, quantiles


def print_timing(report: TimingReport, console: Console) -> None:
    """Print the report as tables."""
    console.print(_overview(report))
    if report.simulated:
        console.print(SIMULATED)
    if len(report.episodes) > 1:
        console.out(f"Episodes\n{_episodes(report, console.width)}", highlight=False)
    for of, grants in report.grants:
        console.print(_grants(of, grants))


def _overview(report: TimingReport) -> Table:
    total, summary = report.total, report.total.summary
    is_single = len(report.episodes) == 1
    what = f"episode {report.episodes[0].name}" if is_single else f"all {len(report.episodes)} episodes"
    table = Table(title=f"{report.root}, {what}", title_justify="left", show_header=False)
    limits = summary.tolerated

    def tolerated(name: str) -> str:
        return f", tolerated {ms(limits[name])} ms" if name in limits else ""

    frame = quantiles(total.intervals)
    interval = f"shortest {ms(frame['min'])}, p50 {ms(frame['p50'])}, longest {ms(frame['max'])} ms"
    interval += f"; wanted {ms(1 / report.fps)} ms" + (f" ± {ms(limits['jitter'])} ms" if "jitter" in limits else "")
    if report.simulated:
        table.add_row("clock", "lockstep: simulated time")
        table.add_row("control ticks", f"{summary.ticks}")
    else:
        table.add_row("clock", "realtime: wall clock")
        worst = "" if is_single else ", in the worst episode"
        table.add_row("control ticks", f"{summary.ticks} run, {summary.skipped} skipped, {summary.overruns} overran")
        table.add_row("rate error", f"{ticks(summary.rate_error)} ticks in {summary.elapsed:.1f} s{worst}")
        table.add_row("tick lateness", f"{_three(summary, 'lateness', ', ')} ms{worst}{tolerated('lateness')}")
        table.add_row(
            "tick duration",
            f"{_three(summary, 'duration', ', ')} ms{worst}; the period is {ms(summary.period)} ms",
        )
    age = quantiles(total.columns[keys.AGE])
    table.add_row(
        "observation age",
        f"p50 {ms(age['p50'])}, p99 {ms(age['p99'])}, max {ms(age['max'])} ms{tolerated('age')}",
    )
    table.add_row("frame interval", interval)
    if not report.simulated:
        table.add_row("inference time", f"{_three(summary, 'inference', ', ')} ms")
        table.add_row("late frames", _share(summary))
        table.add_row("drops", f"{summary.drops} frames or states lost")
    return table


Cell = Callable[[EpisodeTiming], str]

# Columns of the table of episodes, the most telling ones first: heading, content, width.
_MEASURED: Sequence[tuple[str, Cell]] = (
    ("late\nframes", lambda e: str(e.summary.late_frames)),
    ("skipped", lambda e: str(e.summary.skipped)),
    ("lateness [ms]\np50 / p99 / max", lambda e: _three(e.summary, "lateness", " / ", names=False)),
    ("drops", lambda e: str(e.summary.drops)),
    ("tick duration [ms]\np50 / p99 / max", lambda e: _three(e.summary, "duration", " / ", names=False)),
    ("inference [ms]\np50 / p99 / max", lambda e: _three(e.summary, "inference", " / ", names=False)),
    ("age [ms]\nmax", lambda e: ms(e.summary.age_max)),
    ("overruns", lambda e: str(e.summary.overruns)),
    ("rate\nerror", lambda e: ticks(e.summary.rate_error)),
)
_SIMULATED: Sequence[tuple[str, Cell]] = (
    ("age [ms]\nmax", lambda e: ms(e.columns[keys.AGE].max(initial=0.0))),
    ("interval [ms]\nmin / max", lambda e: " / ".join(ms(quantiles(e.intervals)[k]) for k in ("min", "max"))),
)
_ALWAYS: Sequence[tuple[str, Cell]] = (
    ("episode", lambda e: e.name),
    ("frames", lambda e: str(e.summary.frames)),
    ("ticks", lambda e: str(e.summary.ticks)),
)


def _episodes(report: TimingReport, width: int) -> str:
    everything = (*report.episodes, report.total)
    columns = [
        (heading, [cell(value) for value in everything])
        for heading, cell in (*_ALWAYS, *(_SIMULATED if report.simulated else _MEASURED))
    ]
    return aligned(fitting(columns, width))


def aligned(columns: Sequence[tuple[str, list[str]]], left: Collection[str] = ()) -> str:
    """Return a table as plain lines, numbers to the right: rich takes the greater part of a millisecond for a row."""
    height = max(heading.count("\n") for heading, _ in columns) + 1
    parts, forms = [], []
    for heading, cells in columns:
        above = heading.splitlines()
        parts.append([*[""] * (height - len(above)), *above, *cells])
        forms.append(f"{{:{'<' if heading in left else '>'}{max(map(len, parts[-1]))}}}")
    return "\n".join(map(str.rstrip, map("  ".join(forms).format, *parts)))


def fitting(columns: Sequence[tuple[str, list[str]]], width: int) -> list[tuple[str, list[str]]]:
    """Return the first columns of a table, as many as fit: a column is never cut off."""
    room, shown = width - 1, []
    for heading, cells in columns:
        room -= 3 + max(len(text) for text in [*heading.splitlines(), *cells])
        if room < 0:
            break
        shown.append((heading, cells))
    return shown


def _grants(of: str, grants: Sequence[dict[str, Any]]) -> Table:
    table = Table(title=f"What the control loop was granted, {of}", title_justify="left")
    for heading in ("what", "wanted", "granted", "detail, remedy"):
        table.add_column(heading)
    for grant in grants:
        granted = grant.get("granted", "")
        cells = [grant.get("name", ""), grant.get("wanted", ""), "yes" if granted is True else granted or "no"]
        cells.append("; ".join(str(grant[key]) for key in ("detail", "remedy") if grant.get(key)))
        table.add_row(*(escape(str(cell)) for cell in cells))
    return table


def _three(summary: TimingSummary, kind: str, separator: str, *, names: bool = True) -> str:
    return separator.join(
        (f"{name} " if names else "") + ms(getattr(summary, f"{kind}_{name}")) for name in ("p50", "p99", "max")
    )


def _share(summary: TimingSummary) -> str:
    share = summary.late_frames / summary.frames if summary.frames else 0.0
    allowed = summary.tolerated.get("late_frames")
    return f"{summary.late_frames} of {summary.frames} ({100 * share:.1f} %)" + (
        f", tolerated {100 * allowed:.1f} % of an episode" if allowed is not None else ""
    )


def ticks(number: float) -> str:
    """Return a signed number of ticks; nothing is not less than nothing."""
    return f"{round(number, 2) + 0.0:+.2f}"


def ms(seconds: float) -> str:
    """Return a time in milliseconds with three digits that mean something."""
    value = 1e3 * float(seconds)
    return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:.1f}" if abs(value) >= 9.995 else f"{value:.2f}"
