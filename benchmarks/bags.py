"""Messages a second of `bhd-data export` and `bhd-data import`: `python -m benchmarks.bags`.

A dataset of TurtleBot3 episodes as `bhd-record` writes it (360 beams, no camera) becomes a bag, and the bag a dataset
again. Beside it the `mcap` library writes the same
messages, serialised already, into a file, and reads them without decoding them: what a bag costs at the least in that
library. They run in turns; the first of each is not counted.
"""

import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, rates
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.ros2.bag.exporter.episode import ExportOptions
from bhd_lerobot.ros2.bag.exporter.export import export_bags
from bhd_lerobot.ros2.messages.robot_views import robot_view

FPS = 10


def record(root: Path, episodes: int, frames: int) -> None:
    """Record drives past walls that are somewhere."""
    state = ["x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(360))]
    physics = [f"qpos_{i}" for i in range(9)] + [f"qvel_{i}" for i in range(8)]
    features = keys.dataset_features(state, ["x.vel", "theta.vel"], {}, {keys.PHYSICS_STATE: physics})
    recorder = DatasetRecorder.create("bench/bags", FPS, features, robot_type="turtlebot3", root=root)
    rng, index = np.random.default_rng(0), np.arange(frames)
    for _ in range(episodes):
        columns: dict[str, Any] = {
            key: np.zeros((frames, *one["shape"]) if one["shape"] != (1,) else frames, one["dtype"])
            for key, one in features.items()
        }
        # The lidar is half as fast as the frames.
        scans = rng.uniform(0.12, 3.5, (frames // 2 + 1, 360))[index // 2]
        speeds = 0.2 * np.sin(index / 7)[:, None] * [1, 2]
        columns[keys.OBSERVATION_STATE] = np.concatenate([speeds, scans], axis=1).astype(np.float32)
        columns[keys.ACTION] = columns[keys.APPLIED_ACTION] = (1.1 * speeds).astype(np.float32)
        columns[keys.TIME], columns[keys.AGE] = index / FPS, (index % 2 / FPS).astype(np.float32)
        columns[keys.MODE][:] = 3
        writer = recorder.begin_episode()
        writer.set_columns(columns)
        recorder.save(writer, task="drive", metadata={"outcome": "success"})
    recorder.finalize()


def bare_write(path: Path, schemas: dict[str, bytes], messages: list[tuple[str, str, int, bytes]]) -> None:
    """Write messages with the mcap library, in the way that rosbag2 does by default: chunks without compression."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        kinds = {kind: writer.register_schema(kind, "ros2msg", text) for kind, text in schemas.items()}
        channels: dict[str, int] = {}
        for topic, kind, log_time, payload in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", kinds[kind])
            writer.add_message(channels[topic], log_time, payload, log_time)
        writer.finish()


def bare_read(path: Path) -> tuple[dict[str, bytes], list[tuple[str, str, int, bytes]]]:
    """Read all messages with the mcap library, without decoding them."""
    schemas: dict[str, bytes] = {}
    messages = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            schemas[schema.name] = schema.data
            messages.append((channel.topic, schema.name, message.log_time, message.data))
    return schemas, messages


def import_bag(bag: Path, root: Path) -> None:
    """Import a bag."""
    arguments = ["import", str(bag), "--task=Drive.", "--min_episode_s=0", "--repo_id=bench/bags", f"--root={root}"]
    if data.main(arguments):
        raise AssertionError("The import failed.")


def main() -> int:
    """Print what was measured."""
    options = parse_options(__doc__, episodes=10, frames=(600, "of an episode"), turns=5)
    view, how = robot_view("turtlebot3"), ExportOptions(one_bag=True)
    with tempfile.TemporaryDirectory() as folder:
        root, bag, back, file = (Path(folder) / name for name in ("data", "bag", "back", "bare.mcap"))
        record(root, options.episodes, options.frames)
        export_bags(root, bag, view=view, options=how)
        size = (bag / "bag.mcap").stat().st_size
        schemas, messages = bare_read(bag / "bag.mcap")
        works: dict[str, Callable[[], object]] = {
            "export": lambda: export_bags(root, bag, view=view, options=how),
            "bare mcap write": lambda: bare_write(file, schemas, messages),
            "bare mcap read": lambda: bare_read(file),
            "import": lambda: import_bag(bag, back),
        }
        made = {"export": bag, "import": back}

        def anew(name: str, run: Callable[[], float]) -> float:
            if name in made:
                shutil.rmtree(made[name], ignore_errors=True)
            return run()

        parts = {name: partial(anew, name, run) for name, run in rates(works, len(messages)).items()}
        speeds = in_turns(parts, options.turns)
    report = Report(f"{len(messages):,} messages, {size / 1e6:.1f} MB; messages of the mcap library are not decoded")
    for name, peer in (("export", "bare mcap write"), ("import", "bare mcap read")):
        pair = {f"bhd-data {name}": speeds[name], peer: speeds[peer]}
        report.compare(name, "messages/s", pair, [peer], form=",.0f")
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
