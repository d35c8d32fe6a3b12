"""Speed of bhd-record, beside what it is made of: `python -m benchmarks.record`.

Without a camera: simulated seconds in a second with everything on (physics, cerebellum, lidar or inverse kinematics,
brain, task, recorder, finalising), of the TurtleBot3's avoid task and the UR5's pick task, for one and for many
simulations, beside the bare `Batch.step` with the same number of physics steps and the same scans. With a camera:
frames a second beside MuJoCo's own renderer, in its fastest settings, feeding the same encoder. The two of a pair run
in turns in one process, after a short run that is not counted; the table shows medians. Exits with 3 if a goal is
missed.
"""

import argparse
import io
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks._renderer import BareRenderer, speeds
from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, spread
from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask

# Robot, simulations side by side, episodes, and the goal as times real time.
CASES = (("turtlebot3", 1, 4, 60.0), ("turtlebot3", 64, 64, 300.0), ("ur5", 1, 24, 20.0), ("ur5", 32, 256, 60.0))
CONFIGS = {"turtlebot3": "configs/record/turtlebot3_avoid.yaml", "ur5": "configs/record/ur5_pick.yaml"}
SIZE = (240, 320)
CAMERA_GOAL, IMAGE_GOAL = 0.8, 0.95  # of the peer's speed


def run_record(folder: Path, robot: str, *options: str) -> RecordResult:
    """Record the task of a robot."""
    shutil.rmtree(folder, ignore_errors=True)
    own = [f"--dataset.root={folder / 'dataset'}", f"--output_dir={folder / 'run'}", "--preview_video=false"]
    config = parse(RecordConfig, [f"--config_path={CONFIGS[robot]}", *own, "--seed=1", *options])
    return record(config, Console(file=io.StringIO()))


def real_time(folder: Path, robot: str, n: int, episodes: int, *options: str) -> float:
    """Return simulated seconds in a second of recording."""
    result = run_record(folder, robot, f"--n_envs={n}", f"--dataset.num_episodes={episodes}", *options)
    return result.simulated_s / result.wall_s


def bare_step(robot: str, n: int, simulated_s: float = 20.0) -> float:
    """Return simulated seconds in a second of the physics steps, and of the TurtleBot3 the scans, alone."""
    simulation: Any = Simulation(TurtleBot3Config(), n) if robot == "turtlebot3" else Simulation(UR5Config(), n)
    fps = simulation.rates.fps
    task = AvoidTask(AvoidConfig(), n, fps) if robot == "turtlebot3" else PickTask(PickConfig(), n, fps)
    simulation.reset(np.arange(n), [task.sample(2 * i) for i in range(n)], range(n))
    world, rngs = simulation.world, [np.random.default_rng(i) for i in range(n)]
    if robot == "turtlebot3":
        world.ctrl[:] = 3.0
    started = time.perf_counter()
    for _ in range(round(simulated_s * 5)):  # the lidar's rate
        for _ in range(world.physics_hz // 5):
            world.step(1)
        if robot == "turtlebot3":
            simulation.lidar.scan(rngs)
    return n * simulated_s / (time.perf_counter() - started)


def make_scene() -> Simulation:
    """Return a simulation in a random arena."""
    simulation = Simulation(TurtleBot3Config())
    simulation.reset(np.zeros(1, int), [AvoidTask(AvoidConfig(), 1, 10).sample(0)], [0])
    return simulation


def turn(qpos: np.ndarray, frame: int) -> None:
    """Turn the base a little, as it does in an episode."""
    qpos[3], qpos[6] = np.cos(frame * 0.01), np.sin(frame * 0.01)


def encoded_images(folder: Path, frames: int) -> float:
    """Return images a second of MuJoCo's own renderer feeding our encoder."""
    bare = BareRenderer(make_scene(), SIZE, turn)
    folder.mkdir(parents=True, exist_ok=True)
    encoder = CameraEncoder(folder / "bare.mp4", 10, SIZE, VideoSettings())
    started = time.perf_counter()
    for frame in range(frames):
        encoder.add(*bare.images(["front"], frame))
    encoder.finish()
    seconds = time.perf_counter() - started
    bare.renderer.close()
    return frames / seconds


def without_camera(report: Report, folder: Path, options: argparse.Namespace) -> None:
    """Add the rows of each robot and number of simulations."""
    for robot, n, episodes, goal in CASES:
        if robot not in options.robots or n not in options.n_envs:
            continue
        length = [f"--dataset.episode_time_s={options.simulated_s}"] if robot == "turtlebot3" else []
        real_time(folder, robot, n, n, *length)
        peer = "Batch.step and lidar alone" if robot == "turtlebot3" else "Batch.step alone"
        ours = partial(real_time, folder, robot, n, episodes, *length)
        values = in_turns({"bhd-record": ours, peer: partial(bare_step, robot, n)}, options.repeats, uncounted=0)
        what = f"{robot}, n_envs = {n}"
        report.compare(what, "simulated s per s", values, [peer])
        speed = spread(values["bhd-record"])["median"]
        report.add(f"{what}: times real time", f"{speed:.0f} x", f"at least {goal:.0f} x", met=speed >= goal)


def with_camera(report: Report, folder: Path, options: argparse.Namespace) -> None:
    """Add the rows of recording with a camera, and of rendering alone."""

    def camera() -> float:
        length = f"--dataset.episode_time_s={options.simulated_s}"
        result = run_record(
            folder, "turtlebot3", "--robot.camera=true", "--n_envs=1", "--dataset.num_episodes=1", length
        )
        return result.frames / result.wall_s

    peer = "MuJoCo's renderer and the same encoder"
    parts = {"bhd-record": camera, peer: lambda: encoded_images(folder, round(options.simulated_s * 10))}
    values = in_turns(parts, 2 * options.repeats - 1, uncounted=0)
    report.compare("320x240 camera, 10 fps", "frames/s", values, [peer], goal=CAMERA_GOAL)
    values = speeds(make_scene(), SIZE, ["front"], turn, 300)
    report.compare("one 320x240 image", "images/s", values, ["MuJoCo's renderer"], goal=IMAGE_GOAL)


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    options = parse_options(
        __doc__,
        repeats=3,
        simulated_s=(60.0, "length of an episode of the TurtleBot3"),
        robots={"nargs": "+", "choices": tuple(CONFIGS), "default": list(CONFIGS)},
        n_envs={"type": int, "nargs": "+", "default": [1, 32, 64], "help": "only cases of so many simulations"},
    )
    report, folder = Report("bhd-record"), Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    try:
        without_camera(report, folder, options)
        if "turtlebot3" in options.robots:
            with_camera(report, folder, options)
    except RenderingError as error:
        print(f"Camera not measured: {error}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
