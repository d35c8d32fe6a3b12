"""Merging ten datasets, beside LeRobot's own: `python -m benchmarks.merge`.

Ten datasets of an arm (those of `benchmarks.check`), plain and with video of 96x96, are merged by `bhd-data merge` and
by LeRobot's `merge_datasets`, in turns; the first of each is not counted. Both copy video without encoding and write
every frame's numbers anew. LeRobot's result loses the columns that are ours and the identity, ours keeps them; so more
is done here, not less. Opening the datasets is part of both.
"""

import argparse
import logging
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import av
import numpy as np

from benchmarks._turns import in_turns, ratios, seconds, shown, spread, write
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--datasets", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=100, help="of a dataset without video; a tenth of that with")
    parser.add_argument("--frames", type=int, default=300, help="of an episode")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write what was measured to this file")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    av.logging.set_level(av.logging.ERROR)

    results: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, make, episodes in (
            ("state", record, options.episodes),
            ("video", record_video, options.episodes // 10),
        ):
            roots = [Path(folder) / f"{kind}{number}" for number in range(options.datasets)]
            for root in roots:
                make(root, episodes, options.frames)
            target = Path(folder) / "target"
            merges = {"ours": merge, "theirs": merge_with_lerobot}
            took = in_turns({name: partial(timed, one, roots, target) for name, one in merges.items()}, options.turns)
            faster = spread(ratios(took["theirs"], took["ours"]))
            frames = options.datasets * episodes * options.frames
            times = {name: spread(values)["median"] for name, values in took.items()}
            print(
                f"{kind}: {options.datasets} datasets, {frames:,} frames: {shown(faster, '.1f')} times as fast as "
                f"LeRobot's, {times['ours']:.2f} s and {times['theirs']:.2f} s"
            )
            results[kind] = {"faster": faster, **took, "frames": frames}
    write(options.json, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
