"""`make demo`: record a few episodes, replay one, read the dataset with stock LeRobot, say where everything is."""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from rich.console import Console

from bhd_lerobot.errors import BhdError
from bhd_lerobot.runs import data, record, replay
from bhd_lerobot.runs.config_record import RecordConfig
from bhd_lerobot.runs.configuration import parse

_RECORD = (
    "--robot.type=turtlebot3",
    "--brain.type=gap_follower",
    "--task.type=avoid",
    "--dataset.repo_id=bhd/demo",
    "--seed=1",
)
EPISODES = 12
SECONDS = 60


def _demo(folder: Path) -> None:
    root = folder / "dataset"
    console = Console()
    console.rule(f"1. Record {EPISODES} episodes of a simulated TurtleBot3 that roams random arenas")
    config = parse(
        RecordConfig,
        [
            *_RECORD,
            f"--dataset.num_episodes={EPISODES}",
            f"--n_envs={EPISODES}",
            f"--dataset.episode_time_s={SECONDS}",
            f"--dataset.root={root}",
            f"--output_dir={folder}",
        ],
    )
    record.record(config, console)
    console.rule("2. Replay the first: the recorded actions again, and each recorded state again")
    replay.replay(parse(replay.ReplayConfig, [f"--dataset.root={root}", f"--output_dir={folder}"]), console)
    console.rule("3. What is in the dataset")
    data.info(root, console)
    console.rule("4. The same dataset, read by LeRobot")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # seconds to import

    dataset = LeRobotDataset("bhd/demo", root=root, video_backend="pyav")
    frame = dataset[0]
    console.print(
        f"LeRobotDataset: {dataset.num_episodes} episodes, {dataset.num_frames} frames; frame 0 has "
        f"observation.state {tuple(frame['observation.state'].shape)} and action {frame['action'].tolist()}"
    )
    console.rule("Done")
    console.print(f"dataset          {root}")
    for name in ("trajectories.png", "episode.mp4", "episode_000000_open_loop.png", "config.yaml"):
        if (folder / name).exists():
            console.print(f"{name:<16} {folder / name}", soft_wrap=True)


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
