"""Merging ten datasets, beside LeRobot's own: `python -m benchmarks.merge`.

Ten datasets of an arm (those of `benchmarks.check`), plain and with video of 96x96, are merged by `bhd-data merge` and
by LeRobot's `merge_datasets`, in turns; the first of each is not counted. Both copy video without encoding and write
every frame's numbers anew. LeRobot's result loses the columns that are ours and the identity, ours keeps them; so more
is done here, not less. Opening the datasets is part of both.
"""

import logging
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import av
import numpy as np

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, seconds
from benchmarks.check import record
from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

CAMERA = "observation.images.front"


def record_video(root: Path, episodes: int, frames: int) -> None:
    """Record a state and a video of coloured noise that drifts."""
    features = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
        CAMERA: {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
    }
    recorder = DatasetRecorder.create("bench/merge", 25, features, robot_type="ur5", root=root, recording={"seed": 0})
    image = np.random.default_rng(0).integers(0, 255, (96, 96, 3), np.uint8)
    for episode in range(episodes):
        writer = recorder.begin_episode()
        writer.set_columns({"observation.state": np.full((frames, 2), episode, np.float32)})
        for frame in range(frames):
            writer.add_image(CAMERA, np.roll(image, frame, axis=0))
        recorder.save(writer, task="move", metadata={"outcome": "success"})
    recorder.finalize()


def merge_with_lerobot(roots: list[Path], target: Path) -> None:
    """Merge with LeRobot's `merge_datasets`."""
    from lerobot.datasets.dataset_tools import merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    merge_datasets([LeRobotDataset("bench/merge", root=root) for root in roots], "bench/all", target)


def timed(merge_into: Callable[[list[Path], Path], object], roots: list[Path], target: Path) -> float:
    """Return how long a merge takes [s]; what it made is removed."""
    took = seconds(lambda: merge_into(roots, target))
    shutil.rmtree(target)
    return took


def main() -> int:
    """Print what was measured."""
    help_text = "of a dataset without video; a tenth of that with"
    options = parse_options(__doc__, datasets=10, episodes=(100, help_text), frames=(300, "of an episode"), turns=5)
    logging.disable(logging.WARNING)
    av.logging.set_level(av.logging.ERROR)
    report = Report(f"Merging {options.datasets} datasets")
    with tempfile.TemporaryDirectory() as folder:
        for kind, make, episodes in (
            ("state", record, options.episodes),
            ("video", record_video, options.episodes // 10),
        ):
            roots = [Path(folder) / f"{kind}{number}" for number in range(options.datasets)]
            for root in roots:
                make(root, episodes, options.frames)
            frames = options.datasets * episodes * options.frames
            merges = {"bhd-data merge": merge, "LeRobot's": merge_with_lerobot}
            parts = {name: partial(timed, one, roots, Path(folder) / "target") for name, one in merges.items()}
            times = in_turns(parts, options.turns)
            speeds = {name: [frames / took for took in values] for name, values in times.items()}
            report.compare(f"{kind}, {frames:,} frames", "frames/s", speeds, ["LeRobot's"], form=",.0f")
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
