"""Frames a second of `bhd-data check`: `python -m benchmarks.check`.

A dataset of 1,000 episodes without cameras, as an arm with six joints and a gripper gives it (14 numbers of state, 7
of action, LeRobot's index columns), beside reading the same files with Arrow and doing nothing with them. They run in
turns; the first of each is not counted.
"""

import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, rates, spread
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

GOAL = 1e6  # frames a second
FPS = 25
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")


def record(root: Path, episodes: int, frames: int) -> None:
    """Record arms that move smoothly."""
    names = [f"{joint}.pos" for joint in JOINTS]
    features = {
        "observation.state": {
            "dtype": "float32",
            "shape": (14,),
            "names": names + [f"{joint}.vel" for joint in JOINTS],
        },
        "action": {"dtype": "float32", "shape": (7,), "names": names},
    }
    recorder = DatasetRecorder.create("bench/check", FPS, features, robot_type="ur5", root=root, recording={"seed": 0})
    time_s = np.arange(frames)[:, None] / FPS
    for episode in range(episodes):
        rng = np.random.default_rng(episode)
        phase, rate = rng.uniform(0, 6.28, (2, 7))
        position = np.abs(0.04 * np.sin(rate * time_s + phase))
        speed = 0.04 * rate * np.cos(rate * time_s + phase)
        noise = rng.normal(0, 1e-5, position.shape)
        writer = recorder.begin_episode()
        writer.set_columns(
            {
                "observation.state": np.concatenate([position + np.abs(noise), speed], axis=1).astype(np.float32),
                "action": position.astype(np.float32),
            }
        )
        recorder.save(writer, task="move", metadata={"outcome": "success"})
    recorder.finalize()


def read(root: Path) -> None:
    """Read all data files."""
    for path in sorted((root / "data").rglob("*.parquet")):
        pq.ParquetFile(path, page_checksum_verification=True).read()


def check(root: Path) -> None:
    """Check the dataset."""
    found = check_dataset(root)
    if any(finding.severity for finding in found.findings):
        raise AssertionError(f"The dataset is not valid: {found.findings}")


def main() -> int:
    """Print what was measured; return 3 if the goal was missed."""
    options = parse_options(__doc__, episodes=1000, frames=(500, "of an episode"), turns=7)
    total = options.episodes * options.frames
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "data"
        record(root, options.episodes, options.frames)
        works = {"bhd-data check": partial(check, root), "reading alone": partial(read, root)}
        speeds = in_turns(rates(works, total), options.turns)
    report = Report(f"{options.episodes} episodes, {total:,} frames")
    report.compare("validation", "frames/s", speeds, ["reading alone"], form=",.0f")
    speed = spread(speeds["bhd-data check"])["median"]
    report.add("bhd-data check: frames/s", f"{speed:,.0f}", f"at least {GOAL:,.0f}", met=speed >= GOAL)
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
