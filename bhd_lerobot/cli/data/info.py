"""`bhd-data info`: what is in a dataset."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.cli.data.command import Commands, add_command, roots_of
from bhd_lerobot.cli.data.episode_list import short as ranges
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.summary import DatasetSummary, dataset_info, is_being_written
from bhd_lerobot.datasets.timing import grants_of, ms, timing_of
from bhd_lerobot.errors import DatasetError, counted
from bhd_lerobot.options.terminal import Terminal
from bhd_lerobot.realtime.timing import TimingSummary


def add_to(commands: Commands) -> None:
    """Add `info`."""
    help_text = "print a dataset's features, and outcome and timing of every episode; changes nothing"
    command = add_command(commands, "info", help_text, _run, takes_several=True)
    how = command.add_mutually_exclusive_group()
    how.add_argument("--short", action="store_true", help="print one line for each dataset")
    how.add_argument("--json", action="store_true", help="everything as JSON; of several datasets, a list")


def _run(options: argparse.Namespace) -> int:
    roots = roots_of(options)
    if options.short:
        return short(roots)
    if options.json:
        values = [_plain(dataset_info(root)) for root in roots]
        print(json.dumps(values if len(values) > 1 else values[0], indent=1, default=str))
        return 0
    for root in roots:
        info(root, Terminal())
    return 0


def short(roots: Sequence[Path]) -> int:
    """Print a line for each dataset; return the exit status: 2 if one of them is none, after all were printed."""
    status = 0
    for root in roots:
        try:
            print(_line(dataset_info(root)))
        except DatasetError as error:
            print(f"error: {error}", file=sys.stderr)
            status = 2
    return status


def _line(summary: DatasetSummary) -> str:
    parts = [
        str(summary.robot_type),
        *_amount(summary),
        f"{summary.size / 1e6:.1f} MB",
        _outcomes(summary),
        _unfinished(summary),
    ]
    return f"{summary.root}: {', '.join(part for part in parts if part)}"


def _unfinished(summary: DatasetSummary) -> str:
    """Return why a dataset is not finalised; empty if it is."""
    if is_being_written(summary.root):
        return "not finalised: it is being recorded or changed at this moment"
    return "" if summary.compact else "not finalised: an interrupted recording; `bhd-data repair` finishes it"


def _amount(summary: DatasetSummary) -> list[str]:
    if not summary.episodes:
        return ["empty: no episodes"]
    seconds = summary.frames / summary.fps
    return [counted(len(summary.episodes), "episode"), counted(summary.frames, "frame"), f"{seconds:.0f} s"]


def _outcomes(summary: DatasetSummary) -> str:
    outcomes = Counter(str(e.metadata["outcome"]) for e in summary.episodes if "outcome" in e.metadata)
    return ", ".join(f"{name} {count}" for name, count in outcomes.most_common())


def info(root: Path, console: Console) -> None:
    """Print what is in a dataset."""
    summary = dataset_info(root)
    state = _unfinished(summary) or "finalised"
    table = Table(title=escape(str(summary.root)), title_justify="left", show_header=False)
    table.add_row("robot", escape(f"{summary.robot_type}, {summary.fps} frames/s"))
    table.add_row("content", ", ".join(_amount(summary)))
    table.add_row("files", f"{summary.files}, {summary.size / 1e6:.1f} MB, {escape(state)}")
    table.add_row("tasks", escape("; ".join(summary.tasks)))
    for part in ("brain", "task"):
        if part in summary.recording:
            chosen = summary.recording[part]
            table.add_row(part, escape(", ".join(f"{key} {value}" for key, value in chosen.items())))
    if "seed" in summary.recording:
        table.add_row("seed", f"{summary.recording['seed']} ({summary.recording.get('split')})")
    timings = [timing_of(episode) for episode in summary.episodes]
    _add_timing(table, [t for t in timings if t is not None])
    if outcomes := _outcomes(summary):
        table.add_row("outcomes", escape(outcomes))
    console.print(table)
    features = Table(title="Features", title_justify="left")
    for heading in ("key", "type", "shape", "meaning"):
        features.add_column(heading)
    for key, feature in summary.features.items():
        # Units stand in square brackets, which rich would take for markup.
        features.add_row(key, feature["dtype"], str(tuple(feature["shape"])), escape(keys.meaning_of(key, feature)))
    console.print(features)
    _print_grants(summary, console)
    if not summary.episodes:
        return
    tasks = [" ".join(episode.task.split()) for episode in summary.episodes]
    has_tasks = len(set(tasks)) > 1
    # At least a few words of the instruction, if there is a column for it; it is the last one, and not cut off.
    shown = fitting(_episode_columns(summary, timings), console.width - 33 * has_tasks)
    shown += [("instruction", tasks)] if has_tasks else []
    console.out(f"Episodes\n{aligned(shown, left=('outcome', 'instruction'))}", highlight=False)


def _episode_columns(summary: DatasetSummary, timings: Sequence[TimingSummary | None]) -> list[tuple[str, list[str]]]:
    """Return the table of episodes by columns, the most telling ones first."""
    measured: tuple[tuple[str, Callable[[TimingSummary], str]], ...] = (
        ("late frames", lambda t: str(t.late_frames)),
        ("skipped", lambda t: str(t.skipped)),
        ("late p99 / ms", lambda t: ms(t.lateness_p99)),
        ("overruns", lambda t: str(t.overruns)),
        ("drops", lambda t: str(t.drops)),
        ("age max / ms", lambda t: ms(t.age_max)),
        ("tick p99 / ms", lambda t: ms(t.duration_p99)),
        ("inference p99 / ms", lambda t: ms(t.inference_p99)),
        ("rate error / ticks", lambda t: f"{round(t.rate_error, 2) + 0.0:+.2f}"),
    )
    timing = [(heading, ["" if t is None else cell(t) for t in timings]) for heading, cell in measured]
    metadata = [episode.metadata for episode in summary.episodes]
    seed = ("seed", [str(values.get("seed", "")) for values in metadata])
    simulated = all(t is None or t.clock == "lockstep" for t in timings)
    return [
        ("episode", [str(one.index) for one in summary.episodes]),
        ("frames", [str(one.frames) for one in summary.episodes]),
        ("seconds", [f"{one.frames / summary.fps:.1f}" for one in summary.episodes]),
        ("outcome", [str(values.get("outcome", "")) for values in metadata]),
        ("score", [_score(values.get("score")) for values in metadata]),
        *([seed, *timing] if simulated else [*timing, seed]),
    ]


def _score(score: object) -> str:
    return "" if score is None else f"{score:.3f}" if isinstance(score, int | float) else str(score)


def _add_timing(table: Table, timings: Sequence[TimingSummary]) -> None:
    """Add what was measured on the wall clock: counts are sums, times those of the worst episode."""
    measured = [t for t in timings if t.clock != "lockstep"]
    if not measured:
        if timings:
            table.add_row("timing", "simulated time (lockstep): nothing can be late")
        return

    def total(name: str) -> int:
        return sum(getattr(t, name) for t in measured)

    def worst(name: str) -> str:
        limits = {ms(t.tolerated[name]) for t in measured if name in t.tolerated}
        times = [f"{part} {ms(max(getattr(t, f'{name}_{part}') for t in measured))}" for part in ("p50", "p99", "max")]
        return f"{', '.join(times)} ms{f', tolerated {limits.pop()} ms' if len(limits) == 1 else ''}"

    late, frames = total("late_frames"), total("frames")
    table.add_row(
        "timing", f"wall clock: {late} of {frames} frames ({100 * late / max(frames, 1):.1f} %) out of tolerance"
    )
    ticks = f"{total('ticks')} run, {total('skipped')} skipped, {total('overruns')} overran"
    table.add_row("control ticks", f"{ticks}; {total('drops')} frames or states lost")
    table.add_row("tick lateness", worst("lateness"))
    table.add_row("tick duration", f"{worst('duration')}; the period is {ms(max(t.period for t in measured))} ms")
    table.add_row("inference time", worst("inference"))


def _print_grants(summary: DatasetSummary, console: Console) -> None:
    """Print what the control loop was granted, once for the episodes in which it was the same."""
    found: dict[str, list[int]] = {}
    for episode in summary.episodes:
        if grants := grants_of(episode):
            found.setdefault(json.dumps(grants), []).append(episode.index)
    for text, episodes in found.items():
        title = (
            f"What the control loop was granted, {'episode' if len(episodes) == 1 else 'episodes'} {ranges(episodes)}"
        )
        table = Table(title=title, title_justify="left")
        for heading in ("what", "wanted", "granted", "detail, remedy"):
            table.add_column(heading)
        for grant in json.loads(text):
            said = "; ".join(str(grant[key]) for key in ("detail", "remedy") if grant[key])
            cells = (
                grant["name"],
                grant["wanted"],
                "yes" if grant["granted"] is True else grant["granted"] or "no",
                said,
            )
            table.add_row(*(escape(str(cell)) for cell in cells))
        console.print(table)


def aligned(columns: Sequence[tuple[str, list[str]]], left: Collection[str] = ()) -> str:
    """Return a table as plain lines, numbers to the right: rich takes the greater part of a millisecond for a row."""
    forms = [f"{{:{'<' if heading in left else '>'}{max(map(len, (heading, *cells)))}}}" for heading, cells in columns]
    rows = zip(*((heading, *cells) for heading, cells in columns), strict=True)
    return "\n".join("  ".join(forms).format(*row).rstrip() for row in rows)


def fitting(columns: Sequence[tuple[str, list[str]]], width: int) -> list[tuple[str, list[str]]]:
    """Return the first columns of a table, as many as fit: a column is never cut off."""
    room, shown = width - 1, []
    for heading, cells in columns:
        room -= 3 + max(map(len, (heading, *cells)))
        if room < 0:
            break
        shown.append((heading, cells))
    return shown


def _plain(summary: DatasetSummary) -> dict[str, Any]:
    values = asdict(summary)
    values["bytes"] = values.pop("size")
    return values
