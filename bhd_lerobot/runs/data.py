"""`bhd-data`: look at a dataset, mend one."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.data import features as keys
from bhd_lerobot.data.identity import default_root
from bhd_lerobot.data.inspect import DatasetSummary, EpisodeSummary, dataset_info
from bhd_lerobot.data.repair import repair
from bhd_lerobot.errors import BhdError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bhd-data", description="Look at a LeRobotDataset, or mend one.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, help_text in (
        ("info", "what is in a dataset: features, and outcome and timing of every episode; changes nothing"),
        ("repair", "complete or drop what an interrupted recording left, and leave the dataset compact"),
    ):
        command = commands.add_parser(name, help=help_text, description=help_text)
        command.add_argument("root", nargs="?", type=Path, help="folder of the dataset")
        command.add_argument("--root", dest="root_option", type=Path, help="the same, as an option")
        command.add_argument("--repo_id", help="name of the dataset, to find it in LeRobot's default place")
        if name == "info":
            command.add_argument("--json", action="store_true", help="print everything as JSON")
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
    told = len({episode.task for episode in summary.episodes}) > 1
    headings = ["episode", "frames", "seconds", "outcome", "score"]
    # The rest where there is room: a table whose every word is cut off tells nothing.
    rest = ["seed", "overruns", "late p99 / ms"] if console.width >= _WIDE else []
    for heading in headings + rest + ["instruction"] * told:
        left = heading in ("outcome", "instruction")
        episodes.add_column(heading, justify="left" if left else "right", no_wrap=left)
    for episode in summary.episodes:
        row = _episode_row(episode, summary.fps)[: len(headings) + len(rest)]
        episodes.add_row(*row, *[escape(episode.task)] * told)
    console.print(episodes)


def _episode_row(episode: EpisodeSummary, fps: int) -> list[str]:
    metadata = episode.metadata
    timing = json.loads(metadata["timing"]) if "timing" in metadata else {}
    score = metadata.get("score")
    return [
        str(episode.index),
        str(episode.frames),
        f"{episode.frames / fps:.1f}",
        str(metadata.get("outcome", "")),
        "" if score is None else f"{score:.3f}",
        str(metadata.get("seed", "")),
        str(timing.get("overruns", "")),
        f"{timing['lateness_p99'] * 1e3:.2f}" if timing else "",
    ]


def _meaning(key: str, feature: dict[str, Any]) -> str:
    if key in keys.SCALARS:
        return keys.SCALARS[key][1]
    if key in _LEROBOT_COLUMNS:
        return _LEROBOT_COLUMNS[key]
    names = feature.get("names") or []
    if isinstance(names, list) and len(names) > 6:
        return f"{', '.join(map(str, names[:3]))}, … {names[-1]}"
    return ", ".join(map(str, names)) if isinstance(names, list) else ""


_WIDE = 110  # columns of a terminal that hold the whole table

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
        else:
            print(repair(root))
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
