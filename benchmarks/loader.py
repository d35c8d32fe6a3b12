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
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns
from bhd_lerobot.cli.record import main as record_main
from bhd_lerobot.datasets.loader.loader import LoaderConfig, make_loader

BATCH, CHUNK, WORKERS = 64, 50, (0, 2)
NAMES = ("ours", *(f"LeRobot, {n} workers" for n in WORKERS))
# What is recorded, with which further options, how it is shown, and the goal, over the better of LeRobot's speeds.
CASES = {
    "state": ("configs/record/ur5_reach.yaml", (), "loader, state data, chunks of 50 steps", 200.0),
    "cameras": (
        "configs/record/ur5_pick_camera.yaml",
        ("--robot.camera_width=96", "--robot.camera_height=96", "--task.randomisation.enabled=false"),
        "loader, two cameras of 96 x 96 pixels",
        10.0,
    ),
}
EPISODES = (50, 12)  # of each
BETTER = "LeRobot's better"


def record_dataset(root: Path, name: str, episodes: int) -> str:
    """Record a dataset with `bhd-record`; return what went wrong, if something did.

    In a process of its own: PyTorch's workers are copies of this one, and do not survive a renderer's threads in it. It
    is a copy, too, which need not import anything: call this before anything else starts threads.
    """
    config, options, *_ = CASES[name]
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


def compare(report: Report, what: str, unit: str, found: dict[str, list[float]], goal: float | None = None) -> None:
    """Add rows of speeds, with the ratio to LeRobot's better number of workers in each turn."""
    better = [max(theirs) for theirs in zip(*(found[name] for name in NAMES[1:]), strict=True)]
    report.compare(what, unit, {**found, BETTER: better}, [BETTER], goal=goal)


def measure(report: Report, root: Path, name: str, options: argparse.Namespace) -> None:
    """Add the rows of a dataset."""
    *_, what, goal = CASES[name]
    fps = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))["fps"]
    starts: dict[str, Callable[[], Any]] = {
        one: partial(LeRobots, root, fps, workers) for one, workers in zip(NAMES[1:], WORKERS, strict=True)
    }
    starts = {NAMES[0]: partial(Ours, root, fps), **starts}
    streams = {one: start().batches() for one, start in starts.items()}
    parts = {one: partial(samples_per_second, stream, options.seconds) for one, stream in streams.items()}
    compare(report, what, "samples/s", in_turns(parts, options.repeats, uncounted=0), goal)
    for end, batches, turns in () if options.no_start else (("first batch", 1, 3), ("first epoch", None, 1)):
        times = in_turns({one: partial(timed, start, batches) for one, start in starts.items()}, turns, uncounted=0)
        speeds = {one: [1 / took for took in values] for one, values in times.items()}
        compare(report, f"{what}, from closed files to the end of the {end}", "1/s", speeds)


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    options = parse_options(
        __doc__,
        repeats=3,
        episodes={"type": int, "nargs": 2, "default": EPISODES, "metavar": tuple(CASES), "help": "0 leaves it out"},
        seconds=(3.0, "length of one measurement [s]"),
        no_start=(False, "do not time starts"),
    )
    report = Report("Loader: batches of 64, action chunks of 50 steps")
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    try:
        counts = {name: episodes for name, episodes in zip(CASES, options.episodes, strict=True) if episodes}
        problems = {name: record_dataset(folder / name, name, episodes) for name, episodes in counts.items()}
        for name, error in problems.items():
            if error:
                print(f"{name}: nothing was recorded. {error}")
                report.add(CASES[name][2], "not measured: its dataset could not be recorded", met=False)
            else:
                measure(report, folder / name, name, options)
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(folder)
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
