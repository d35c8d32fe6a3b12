"""`make demo`: record two robots, replay an episode of each, read a dataset with LeRobot, say where everything is."""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from rich.console import Console

from bhd_lerobot.errors import BhdError
from bhd_lerobot.runs import data, record, replay
from bhd_lerobot.runs.config_record import RecordConfig
from bhd_lerobot.runs.configuration import parse

_BASE = (
    "--robot.type=turtlebot3",
    "--brain.type=gap_follower",
    "--task.type=avoid",
    "--dataset.repo_id=bhd/demo_base",
    "--seed=1",
)
_ARM = (
    "--robot.type=ur5",
    "--brain.type=language",
    "--task.type=pick",
    "--task.language=any",
    "--dataset.repo_id=bhd/demo_arm",
    "--seed=11",
)
EPISODES, SECONDS = 12, 60
PICKS = 6


def _demo(folder: Path) -> None:
    console = Console()
    console.rule(f"1. Record {EPISODES} episodes of a simulated TurtleBot3 that roams random arenas")
    base = _record((*_BASE, f"--dataset.episode_time_s={SECONDS}"), EPISODES, folder / "turtlebot3", console)
    console.rule(f"2. Record {PICKS} episodes of a simulated UR5 that picks up what it is told to")
    arm = _record(_ARM, PICKS, folder / "ur5", console)
    console.rule("3. Replay the first of each: the recorded commands again, and each recorded state again")
    for dataset in (base, arm):
        options = [f"--dataset.root={dataset}", f"--output_dir={dataset.parent}"]
        replay.replay(parse(replay.ReplayConfig, options), console)
    console.rule("4. What is in the dataset of the UR5")
    data.info(arm, console)
    console.rule("5. The same dataset, read by LeRobot")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # seconds to import

    read = LeRobotDataset("bhd/demo_arm", root=arm, video_backend="pyav")
    frame = read[read.num_frames // 2]
    console.print(f"LeRobotDataset: {read.num_episodes} episodes, {read.num_frames} frames; one in the middle:")
    for key in ("task", "subtask"):
        console.print(f"  {key}: {frame[key]}", highlight=False)
    for key in ("observation.state", "observation.environment_state", "action"):
        console.print(f"  {key}: {tuple(frame[key].shape)}", highlight=False)
    console.rule("Done")
    for dataset in (base, arm):
        console.print(f"{dataset.parent.name}: dataset {dataset}", soft_wrap=True)
        for name in ("trajectories.png", "episode.png", "episode.mp4", "episode_000000_open_loop.png", "config.yaml"):
            if (dataset.parent / name).exists():
                console.print(f"  {dataset.parent / name}", soft_wrap=True)


def _record(options: tuple[str, ...], episodes: int, folder: Path, console: Console) -> Path:
    """Record a dataset into a folder of its own; return where it is."""
    root = folder / "dataset"
    where = (f"--dataset.root={root}", f"--output_dir={folder}")
    counts = (f"--dataset.num_episodes={episodes}", f"--n_envs={episodes}")
    record.record(parse(RecordConfig, [*options, *where, *counts]), console)
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(arguments[0] if arguments else f"outputs/demo/{datetime.now():%Y-%m-%d_%H-%M-%S}")
    try:
        _demo(folder)
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
