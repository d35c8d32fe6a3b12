"""`bhd-data`: look at a dataset and its timing, check one, mend one."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.control.timing import TimingSummary
from bhd_lerobot.data import features as keys
from bhd_lerobot.data.identity import default_root
from bhd_lerobot.data.inspect import DatasetSummary, dataset_info
from bhd_lerobot.data.repair import repair
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.runs.data_check import check
from bhd_lerobot.runs.timing_report import load_timing, timing_of
from bhd_lerobot.runs.timing_tables import fitting, ms, print_timing


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bhd-data", description="Look at a LeRobotDataset, check or mend one.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, help_text in (
        ("info", "what is in a dataset: features, and outcome and timing of every episode; changes nothing"),
        ("timing", "how punctual a recording was: tables and a picture; changes nothing"),
        ("check", "is a dataset sound? Exit status 0 if it is, 1 if not; changes nothing"),
        ("repair", "complete or drop what an interrupted recording left, and leave the dataset compact"),
    ):
        command = commands.add_parser(name, help=help_text, description=help_text)
        command.add_argument("root", nargs="?", type=Path, help="folder of the dataset")
        command.add_argument("--root", dest="root_option", type=Path, help="the same, as an option")
        command.add_argument("--repo_id", help="name of the dataset, to find it in LeRobot's default place")
        if name in ("info", "timing", "check"):
            command.add_argument("--json", action="store_true", help="print everything as JSON")
        if name == "check":
            command.add_argument("--strict", action="store_true", help="a warning is enough for exit status 1")
            command.add_argument("--no-videos", action="store_true", help="leave the films out, which take longest")
        if name == "timing":
            command.add_argument("--episode", type=int, help="this episode only")
            command.add_argument(
                "--output",
                type=Path,
                help="picture, PNG, PDF or SVG; outputs/timing/NAME.png if nothing, and none with --json",
            )
    return parser


def info(root: Path, console: Console, as_json: bool = False) -> None:
    """Print what is in a dataset.

    Raises:
        DatasetError: there is none, or a file cannot be read.
    """
    summary = dataset_info(root)
    if as_json:
        print(json.dumps(_plain(summary), indent=1))
        return
    state = "finalised" if summary.compact else "not finalised: an interrupted recording; `bhd-data repair` finishes it"
    table = Table(title=str(summary.root), title_justify="left", show_header=False)
    table.add_row("robot", f"{summary.robot_type}, {summary.fps} frames/s")
    table.add_row("episodes", f"{len(summary.episodes)}, {summary.frames} frames, {summary.frames / summary.fps:.0f} s")
    table.add_row("files", f"{summary.files}, {summary.size / 1e6:.1f} MB, {state}")
    table.add_row("tasks", "; ".join(summary.tasks))
    for part in ("brain", "task"):
        if part in summary.recording:
            chosen = summary.recording[part]
            table.add_row(part, ", ".join(f"{key} {value}" for key, value in chosen.items()))
    if "seed" in summary.recording:
        table.add_row("seed", f"{summary.recording['seed']} ({summary.recording.get('split')})")
    timings = [timing_of(episode) for episode in summary.episodes]
    if any(timings):
        table.add_row("timing", _timing([t for t in timings if t is not None]))
    outcomes = Counter(str(e.metadata["outcome"]) for e in summary.episodes if "outcome" in e.metadata)
    if outcomes:
        table.add_row("outcomes", ", ".join(f"{name} {count}" for name, count in outcomes.most_common()))
    console.print(table)
    features = Table(title="Features", title_justify="left")
    for heading in ("key", "type", "shape", "meaning"):
        features.add_column(heading)
    for key, feature in summary.features.items():
        # Units stand in square brackets, which rich would take for markup.
        features.add_row(key, feature["dtype"], str(tuple(feature["shape"])), escape(_meaning(key, feature)))
    console.print(features)
    episodes = Table(title="Episodes", title_justify="left")
    columns = _episode_columns(summary, timings)
    told = len({episode.task for episode in summary.episodes}) > 1
    # At least a few words of the instruction, if it is told; it wraps.
    shown = fitting(columns, console.width - 33 * told) if summary.episodes else columns
    for heading, _ in shown:
        episodes.add_column(heading, justify="left" if heading == "outcome" else "right", no_wrap=True)
    if told:
        episodes.add_column("instruction")
    for row, episode in zip(zip(*(cells for _, cells in shown), strict=True), summary.episodes, strict=True):
        episodes.add_row(*row, *[escape(episode.task)] * told)
    console.print(episodes)


def _episode_columns(summary: DatasetSummary, timings: Sequence[TimingSummary | None]) -> list[tuple[str, list[str]]]:
    """Return the table of episodes by columns, the most telling ones first."""
    measured: tuple[tuple[str, Callable[[TimingSummary], str]], ...] = (
        ("late frames", lambda t: str(t.late_frames)),
        ("skipped", lambda t: str(t.skipped)),
        ("late p99 / ms", lambda t: ms(t.lateness_p99)),
        ("overruns", lambda t: str(t.overruns)),
        ("drops", lambda t: str(t.drops)),
        ("age max / ms", lambda t: ms(t.age_max)),
    )
    timing = [(heading, ["" if t is None else cell(t) for t in timings]) for heading, cell in measured]
    metadata = [episode.metadata for episode in summary.episodes]
    seed = ("seed", [str(one.get("seed", "")) for one in metadata])
    simulated = all(t is None or t.clock == "lockstep" for t in timings)
    return [
        ("episode", [str(one.index) for one in summary.episodes]),
        ("frames", [str(one.frames) for one in summary.episodes]),
        ("seconds", [f"{one.frames / summary.fps:.1f}" for one in summary.episodes]),
        ("outcome", [str(one.get("outcome", "")) for one in metadata]),
        ("score", ["" if one.get("score") is None else f"{one['score']:.3f}" for one in metadata]),
        *([seed, *timing] if simulated else [*timing, seed]),
    ]


def timing(root: Path, console: Console, episode: int | None, output: Path | None, as_json: bool = False) -> None:
    """Print how punctual a recording was, and draw it.

    Args:
        root: the dataset.
        console: where it is printed.
        episode: the only episode that is wanted; all if None.
        output: where the picture goes; `outputs/timing` if None, and nowhere with `as_json`.
        as_json: print plain values.

    Raises:
        DatasetError: there is no such dataset or episode, or it says nothing about its timing.
        ConfigError: the picture cannot be written.
    """
    if output is not None and output.suffix.lower() not in _PICTURES:
        raise ConfigError(f"--output is {str(output)!r}; the picture can be one of {', '.join(_PICTURES)}.")
    report = load_timing(root, episode)
    if as_json:
        print(json.dumps(report.values(), indent=1))
    else:
        print_timing(report, console)
    if output is None and as_json:
        return
    if output is None:
        name = root.resolve().name + ("" if episode is None else f"_episode_{episode:06d}")
        output = Path("outputs/timing") / f"{name}.png"
    from bhd_lerobot.runs.timing_plots import draw_timing  # half a second to import, which `info` need not wait for

    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        draw_timing(report, output)
    except OSError as error:
        raise ConfigError(f"The picture {output} cannot be written: {error.strerror}. Set --output.") from error
    if not as_json:
        console.print(f"Picture: {output}")


def _timing(timings: Sequence[TimingSummary]) -> str:
    measured = [t for t in timings if t.clock != "lockstep"]
    if not measured:
        return "simulated time: nothing can be late"
    late, frames = sum(t.late_frames for t in measured), sum(t.frames for t in measured)
    skipped, drops = sum(t.skipped for t in measured), sum(t.drops for t in measured)
    return (
        f"wall-clock time: {late} of {frames} frames out of tolerance, {skipped} ticks skipped, {drops} frames or "
        "states lost; `bhd-data timing` says more"
    )


def _meaning(key: str, feature: dict[str, Any]) -> str:
    if key in keys.SCALARS:
        return keys.SCALARS[key][1]
    if key in _LEROBOT_COLUMNS:
        return _LEROBOT_COLUMNS[key]
    names = feature.get("names") or []
    if isinstance(names, list) and len(names) > 6:
        return f"{', '.join(map(str, names[:3]))}, … {names[-1]}"
    return ", ".join(map(str, names)) if isinstance(names, list) else ""


_PICTURES = (".png", ".pdf", ".svg")

_LEROBOT_COLUMNS = {
    keys.SUBTASK: "what the brain was doing, in words",
    "timestamp": "frame_index / fps [s]",
    "frame_index": "number of the frame in its episode",
    "episode_index": "number of the episode in the dataset",
    "index": "number of the frame in the dataset",
    "task_index": "number of the instruction",
}


def _plain(summary: DatasetSummary) -> dict[str, Any]:
    return {
        "root": str(summary.root),
        "robot_type": summary.robot_type,
        "fps": summary.fps,
        "frames": summary.frames,
        "files": summary.files,
        "bytes": summary.size,
        "compact": summary.compact,
        "tasks": list(summary.tasks),
        "recording": summary.recording,
        "features": summary.features,
        "episodes": [
            {"index": e.index, "frames": e.frames, "task": e.task, "metadata": e.metadata} for e in summary.episodes
        ],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-data`; return the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    root = options.root or options.root_option
    if root is None and options.repo_id is None:
        parser.error("name the dataset: its folder, or --repo_id")
    try:
        root = root.expanduser() if root is not None else default_root(options.repo_id)
        if options.command == "info":
            info(root, Console(), options.json)
        elif options.command == "timing":
            output = options.output.expanduser() if options.output is not None else None
            timing(root, Console(), options.episode, output, options.json)
        elif options.command == "check":
            return check(root, Console(), as_json=options.json, is_strict=options.strict, videos=not options.no_videos)
        else:
            print(repair(root))
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        rest = "run it again to finish" if options.command == "repair" else "nothing was changed"
        print(f"Stopped; {rest}.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
