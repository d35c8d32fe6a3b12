"""Merging ten datasets, beside LeRobot's own: `python -m benchmarks.merge`.

Ten datasets of an arm (those of `benchmarks.check`), plain and with a film of 96x96, are merged by `bhd-data merge` and
by LeRobot's `merge_datasets`, in turns; the first of each is not counted. Both copy films without encoding and write
every frame's numbers anew. LeRobot's result loses the columns that are ours and the identity, ours keeps them; so more
is done here, not less. Opening the datasets is part of both.
"""

import argparse
import logging
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import av
import numpy as np

from benchmarks._spread import ratios, spread, write
from benchmarks.check import record
from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

CAMERA = "observation.images.front"


def record_film(root: Path, episodes: int, frames: int) -> None:
    """Record a state and a film of coloured noise that drifts."""
    features = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
        CAMERA: {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
    }
    recorder = DatasetRecorder.create("bench/merge", 25, features, robot_type="ur5", root=root, recording={"seed": 0})
    picture = np.random.default_rng(0).integers(0, 255, (96, 96, 3), np.uint8)
    for episode in range(episodes):
        writer = recorder.begin_episode()
        writer.set_columns({"observation.state": np.full((frames, 2), episode, np.float32)})
        for frame in range(frames):
            writer.add_image(CAMERA, np.roll(picture, frame, axis=0))
        recorder.save(writer, task="move", metadata={"outcome": "success"})
    recorder.finalize()


def ours(roots: list[Path], target: Path) -> float:
    """Return how long our merge takes [s]."""
    started = time.perf_counter()
    merge(roots, target)
    return time.perf_counter() - started


def theirs(roots: list[Path], target: Path) -> float:
    """Return how long LeRobot's takes [s]."""
    from lerobot.datasets.dataset_tools import merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    started = time.perf_counter()
    merge_datasets([LeRobotDataset("bench/merge", root=root) for root in roots], "bench/all", target)
    return time.perf_counter() - started


def main() -> int:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--datasets", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=100, help="of a dataset without film; a tenth of that with")
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
            ("film", record_film, options.episodes // 10),
        ):
            roots = [Path(folder) / f"{kind}{number}" for number in range(options.datasets)]
            for root in roots:
                make(root, episodes, options.frames)
            took: dict[str, list[float]] = {"ours": [], "theirs": []}
            for turn in range(options.turns + 1):
                for name, run in (("ours", ours), ("theirs", theirs)):
                    target = Path(folder) / "target"
                    one = run(roots, target)
                    shutil.rmtree(target)
                    if turn:
                        took[name].append(one)
            faster = spread(ratios(took["theirs"], took["ours"]))
            frames = options.datasets * episodes * options.frames
            print(
                f"{kind}: {options.datasets} datasets, {frames:,} frames: {faster['median']:.1f} times as fast as "
                f"LeRobot's ({faster['low']:.1f} to {faster['high']:.1f}; {statistics.median(took['ours']):.2f} s and "
                f"{statistics.median(took['theirs']):.2f} s)"
            )
            results[kind] = {"faster": faster, **took, "frames": frames}
    write(options.json, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
