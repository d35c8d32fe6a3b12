"""Speed of bhd-record, beside what it is made of: `python -m benchmarks.record`.

Without a camera: simulated seconds in a second with everything on (physics, cerebellum, lidar, brain, task, recorder,
finalising), for 1 and for 64 simulations, beside the bare `Batch.step` with the same number of physics steps and the
same scans. With a camera: frames a second beside MuJoCo's own renderer, in its fastest settings, feeding the same
encoder. The two of a pair run in turns in one process; the table shows medians.
"""

import argparse
import io
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

# MuJoCo's renderer takes its backend from here when it is imported; ours looks for one by itself.
os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.turtlebot3_simulation import TurtleBot3Simulation
from bhd_lerobot.rollout.configuration import parse
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask

GOALS = {"n_envs = 1": 60.0, "n_envs = 64": 300.0, "camera": 0.8, "image": 0.95}


def run_record(folder: Path, *options: str) -> tuple[float, float, int]:
    """Record the avoid task; return simulated seconds, seconds that it took, and frames."""
    shutil.rmtree(folder, ignore_errors=True)
    config = parse(
        RecordConfig,
        [
            "--config_path=configs/record/turtlebot3_avoid.yaml",
            f"--dataset.root={folder / 'dataset'}",
            f"--output_dir={folder / 'run'}",
            "--preview_video=false",
            "--seed=1",
            *options,
        ],
    )
    result = record(config, Console(file=io.StringIO()))
    return result.simulated_s, result.wall_s, result.frames


def bare_step(n: int, seconds: float) -> float:
    """Return how long the physics steps and scans of n simulations take for some simulated time [s]."""
    simulation = TurtleBot3Simulation(TurtleBot3Config(), n)
    task = AvoidTask(AvoidConfig(), n, 10)
    simulation.reset(np.arange(n), [task.sample(2 * i) for i in range(n)], range(n))
    world, lidar = simulation.world, simulation.lidar
    world.ctrl[:] = 3.0
    rngs = [np.random.default_rng(i) for i in range(n)]
    steps = world.physics_hz // 5
    started = time.perf_counter()
    for _ in range(round(seconds * 5)):
        for _ in range(steps):
            world.step(1)
        lidar.scan(rngs)
    return time.perf_counter() - started


def make_scene() -> TurtleBot3Simulation:
    """Return a simulation in a random arena."""
    simulation = TurtleBot3Simulation(TurtleBot3Config())
    simulation.reset(np.zeros(1, int), [AvoidTask(AvoidConfig(), 1, 10).sample(0)], [0])
    return simulation


def images(frames: int) -> tuple[float, float]:
    """Return images a second of our camera and of MuJoCo's own renderer, taken in turns, image by image."""
    simulation = make_scene()
    camera = Camera(simulation.world, 320, 240)
    peer = BareRenderer()
    seconds = np.zeros((frames, 2))
    for frame in range(-1, frames):
        started = time.perf_counter()
        simulation.world.qpos[0, 3], simulation.world.qpos[0, 6] = np.cos(frame * 0.01), np.sin(frame * 0.01)
        camera.render(0, "front")
        between = time.perf_counter()
        peer.image(frame)
        seconds[frame] = between - started, time.perf_counter() - between  # the first is overwritten at the end
    camera.close()
    peer.renderer.close()
    ours, bare = np.median(seconds, axis=0)
    return 1 / ours, 1 / bare


class BareRenderer:
    """MuJoCo's own renderer in its fastest settings, on the scene of an episode."""

    def __init__(self) -> None:
        simulation = make_scene()
        self.model = simulation.world.copy_model(0)
        self.data = mujoco.MjData(self.model)
        simulation.world.copy_into(0, self.model, self.data)
        self.renderer = mujoco.Renderer(self.model, 240, 320)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self.renderer.scene.flags[flag] = False
        self.option = mujoco.MjvOption()
        self.option.geomgroup[:] = [1, 1, 0, 0, 0, 0]
        mujoco.mj_forward(self.model, self.data)
        self.image(0)

    def image(self, frame: int) -> np.ndarray:
        """Return the image of a frame; the view moves as it does in an episode."""
        self.data.qpos[3], self.data.qpos[6] = np.cos(frame * 0.01), np.sin(frame * 0.01)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, "front", self.option)
        return self.renderer.render()


def encoded_images(folder: Path, frames: int) -> float:
    """Return images a second of MuJoCo's own renderer feeding our encoder."""
    bare = BareRenderer()
    folder.mkdir(parents=True, exist_ok=True)
    encoder = CameraEncoder(folder / "bare.mp4", 10, (240, 320), VideoSettings())
    started = time.perf_counter()
    for frame in range(frames):
        encoder.add(bare.image(frame))
    encoder.finish()
    seconds = time.perf_counter() - started
    bare.renderer.close()
    return frames / seconds


def paired(first: Callable[[], float], second: Callable[[], float], repeats: int) -> tuple[float, float, float]:
    """Return the medians of two measurements that are taken in turns, and of their ratio."""
    values = [(first(), second()) for _ in range(repeats)]
    # The median of the ratios, not the ratio of the medians: a noisy neighbour disturbs both of a pair.
    return tuple(statistics.median(column) for column in zip(*[(a, b, a / b) for a, b in values], strict=True))


def main() -> int:
    """Print the table; return 1 if a goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--simulated_s", type=float, default=60.0, help="length of an episode")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    table = Table(title="bhd-record", title_justify="left")
    for heading in ("measured", "ours", "peer", "peer is", "ratio", "goal"):
        table.add_column(heading, justify="left" if heading in ("measured", "peer is") else "right")
    missed = []
    try:
        for n, episodes in ((1, 4), (64, 64)):
            length = f"--dataset.episode_time_s={options.simulated_s}"

            def ours(n: int = n, episodes: int = episodes, length: str = length) -> float:
                simulated, wall, _ = run_record(folder, f"--n_envs={n}", f"--dataset.num_episodes={episodes}", length)
                return simulated / wall

            def bare(n: int = n) -> float:
                seconds = 20.0
                return n * seconds / bare_step(n, seconds)

            mine, peer, ratio = paired(ours, bare, options.repeats)
            key = f"n_envs = {n}"
            missed += [key] * (mine < GOALS[key])
            table.add_row(
                f"{key}: simulated s per s",
                f"{mine:.0f}",
                f"{peer:.0f}",
                "Batch.step and lidar alone",
                f"{ratio:.2f}",
                f">= {GOALS[key]:.0f} x real time",
            )
        try:

            def camera() -> float:
                _, wall, frames = run_record(
                    folder,
                    "--robot.camera=true",
                    "--n_envs=1",
                    "--dataset.num_episodes=1",
                    f"--dataset.episode_time_s={options.simulated_s}",
                )
                return frames / wall

            frames = round(options.simulated_s * 10)
            mine, peer, ratio = paired(camera, lambda: encoded_images(folder, frames), 2 * options.repeats - 1)
            missed += ["camera"] * (ratio < GOALS["camera"])
            table.add_row(
                "320x240 camera, 10 fps: frames per s",
                f"{mine:.0f}",
                f"{peer:.0f}",
                "MuJoCo's renderer and the same encoder",
                f"{ratio:.2f}",
                f"ratio >= {GOALS['camera']}",
            )
            mine, peer = images(300)
            ratio = mine / peer
            missed += ["image"] * bool(ratio < GOALS["image"])
            table.add_row(
                "one 320x240 image: images per s",
                f"{mine:.0f}",
                f"{peer:.0f}",
                "MuJoCo's renderer, fastest settings",
                f"{ratio:.2f}",
                f"ratio >= {GOALS['image']}, the same time",
            )
        except RenderingError as error:
            print(f"Camera not measured: {error}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    Console(width=140).print(table)
    if missed:
        print(f"Missed: {', '.join(missed)}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
