"""Speed of the loader beside LeRobot's dataset and PyTorch's `DataLoader`: `python -m benchmarks.loader`.

Two datasets are recorded first: a UR5 that reaches, without cameras, and one that picks, with two cameras of 96 x 96
pixels. Both sides serve the same samples: every column, action chunks of 50 steps, batches of 64 in random order. They
run in turns in one process; a ratio is the median of the ratios of neighbouring measurements, to LeRobot's better
number of workers. Starting has rows of its own: from a closed dataset, columns and all frames still to be read and
decoded, to the first batch, and to the end of the first epoch.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import cycle, islice
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")

from rich.console import Console
from rich.table import Table

from benchmarks._turns import spread, status, write
from bhd_lerobot.cli.record import main as record_main
from bhd_lerobot.datasets.loader.loader import LoaderConfig, make_loader

BATCH, CHUNK, WORKERS = 64, 50, (0, 2)
NAMES = ("ours", *(f"LeRobot, {n} workers" for n in WORKERS))
# What is recorded, with which further options, and how many times the better of LeRobot's speeds is the goal.
CASES = {
    "state": ("configs/record/ur5_reach.yaml", (), 200.0),
    "cameras": (
        "configs/record/ur5_pick_camera.yaml",
        ("--robot.camera_width=96", "--robot.camera_height=96", "--task.randomisation.enabled=false"),
        10.0,
    ),
}
EPISODES = (50, 12)  # of each


def record_dataset(root: Path, name: str, episodes: int) -> str:
    """Record a dataset with `bhd-record`; return what went wrong, if something did.

    In a process of its own: PyTorch's workers are copies of this one, and do not survive a renderer's threads in it. It
    is a copy, too, which need not import anything: call this before anything else starts threads.
    """
    config, options, _ = CASES[name]
    arguments = [
        f"--config_path={config}",
        f"--dataset.root={root}",
        f"--dataset.num_episodes={episodes}",
        f"--output_dir={root}_run",
        "--preview_video=false",
        "--seed=1",
        *options,
    ]
    log = root.with_suffix(".log")
    recording = multiprocessing.get_context("fork").Process(target=_record, args=(arguments, log))
    recording.start()
    recording.join()
    if recording.exitcode == 0:
        return ""
    said = log.read_text(encoding="utf-8", errors="replace").strip() if log.exists() else ""
    return said or f"bhd-record ended with status {recording.exitcode}."


def _record(arguments: list[str], log: Path) -> None:
    with log.open("w", encoding="utf-8") as file:
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
        sys.exit(record_main(arguments))


def samples_per_second(batches: Iterator[dict[str, Any]], seconds: float) -> float:
    """Return how many samples come in a second, once the first batch is there."""
    next(batches)
    samples, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        samples += len(next(batches)["index"])
    return samples / (time.perf_counter() - started)


class Ours:
    """The loader of this package."""

    def __init__(self, root: Path, fps: int) -> None:
        config = LoaderConfig(batch_size=BATCH, delta_timestamps=chunk(fps))
        self.dataset, self.loader, _, _ = make_loader("bhd/bench", config, root=root)

    def batches(self) -> Iterator[dict[str, Any]]:
        """Return batches for ever."""
        return self.loader.cycle()


class LeRobots:
    """LeRobot's dataset and PyTorch's loader, as `lerobot-train` uses them."""

    def __init__(self, root: Path, fps: int, workers: int) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
        from torch.utils.data import DataLoader

        self.dataset = LeRobotDataset(
            "bhd/bench", root, delta_timestamps=chunk(fps), video_backend="pyav", return_uint8=True
        )
        self.loader = DataLoader(self.dataset, BATCH, shuffle=True, num_workers=workers, persistent_workers=workers > 0)

    def batches(self) -> Iterator[dict[str, Any]]:
        """Return batches for ever."""
        return (batch for epoch in cycle([self.loader]) for batch in epoch)


def chunk(fps: int) -> dict[str, list[float]]:
    """Return the window of an action chunk."""
    return {"action": [step / fps for step in range(CHUNK)]}


def timed(start: Callable[[], Any], batches: int | None) -> float:
    """Return seconds until a loader that is made anew has served so many batches, or an epoch if None."""
    started = time.perf_counter()
    loader = start().loader
    for _ in islice(iter(loader), batches):
        pass
    return time.perf_counter() - started


def measure(root: Path, seconds: float, repeats: int) -> tuple[list[list[float]], int, float]:
    """Return samples a second of ours and LeRobot's, by repeat; the number of samples; mebibytes that ours takes."""
    fps = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["fps"]
    ours = Ours(root, fps)
    mine = ours.batches()
    theirs = [LeRobots(root, fps, workers).batches() for workers in WORKERS]
    values = [[samples_per_second(stream, seconds) for stream in (mine, *theirs)] for _ in range(repeats)]
    return values, len(ours.dataset), ours.dataset.nbytes / 2**20


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--episodes", type=int, nargs=2, default=EPISODES, help="of each dataset; 0 leaves it out", metavar=tuple(CASES)
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="length of one measurement [s]")
    parser.add_argument("--start", action=argparse.BooleanOptionalAction, default=True, help="time starts, too")
    parser.add_argument("--json", type=Path, help="write the numbers to this file as well")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    table = Table(title="Loader: batches of 64, action chunks of 50 steps", title_justify="left")
    for heading in ("measured", *NAMES, "ratio", "goal"):
        table.add_column(heading, justify="left" if heading == "measured" else "right")
    results: dict[str, Any] = {}
    missed = []
    try:
        counts = {name: episodes for name, episodes in zip(CASES, options.episodes, strict=True) if episodes}
        problems = {name: record_dataset(folder / name, name, episodes) for name, episodes in counts.items()}
        for name, error in problems.items():
            root, goal = folder / name, CASES[name][2]
            if error:
                print(f"{name}: nothing was recorded. {error}")
                missed.append(name)
                continue
            values, samples, mebibytes = measure(root, options.seconds, options.repeats)
            ratio = statistics.median(mine / max(theirs) for mine, *theirs in values)
            missed += [name] * (ratio < goal)
            medians = [statistics.median(column) for column in zip(*values, strict=True)]
            table.add_row(
                f"{name}, {samples} samples, {mebibytes:.3g} MiB: samples per s",
                *(f"{value:,.0f}" for value in medians),
                f"{ratio:,.0f}",
                f">= {goal:.0f}",
            )
            results[name] = {
                "samples_per_s": dict(zip(NAMES, map(spread, zip(*values, strict=True)), strict=True)),
                "ratio": spread([mine / max(theirs) for mine, *theirs in values]),
                "goal": goal,
                "met": ratio >= goal,
                "samples": samples,
                "mib": mebibytes,
            }
            fps = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["fps"]
            starts: list[Callable[[], Any]] = [
                lambda root=root, fps=fps: Ours(root, fps),
                *(lambda root=root, fps=fps, workers=workers: LeRobots(root, fps, workers) for workers in WORKERS),
            ]
            for what, batches in (("first batch", 1), ("first epoch", None)) if options.start else ():
                rows = [[timed(start, batches) for start in starts] for _ in range(1 if batches is None else 3)]
                medians = [statistics.median(column) for column in zip(*rows, strict=True)]
                ratio = statistics.median(min(theirs) / mine for mine, *theirs in rows)
                table.add_row(
                    f"{name}: from closed files to the end of the {what}, s",
                    *(f"{value:.2f}" for value in medians),
                    f"{ratio:.3g}",
                    "",
                )
                results[name][what.replace(" ", "_")] = {
                    "seconds": dict(zip(NAMES, map(spread, zip(*rows, strict=True)), strict=True)),
                    "ratio": spread([min(theirs) / mine for mine, *theirs in rows]),
                }
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(folder)
    Console(width=150).print(table)
    write(options.json, results)
    if missed:
        print(f"Missed: {', '.join(missed)}")
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
