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
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

# MuJoCo's renderer takes its backend from here when it is imported; ours looks for one by itself.
os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._turns import in_turns, ratios, spread, status
from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.robots.base_simulation import BaseSimulation
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask

# Robot, simulations side by side, episodes, and the goal as times real time.
CASES = (("turtlebot3", 1, 4, 60.0), ("turtlebot3", 64, 64, 300.0), ("ur5", 1, 24, 20.0), ("ur5", 32, 256, 60.0))
CONFIGS = {"turtlebot3": "configs/record/turtlebot3_avoid.yaml", "ur5": "configs/record/ur5_pick.yaml"}
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
    simulation: Any = BaseSimulation(TurtleBot3Config(), n) if robot == "turtlebot3" else UR5Simulation(UR5Config(), n)
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


def make_scene() -> BaseSimulation:
    """Return a simulation in a random arena."""
    simulation = BaseSimulation(TurtleBot3Config())
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


def paired(first: Callable[[], float], second: Callable[[], float], turns: int) -> tuple[float, float, float]:
    """Return the medians of two measurements that are taken in turns, and of their ratio."""
    values = in_turns({"ours": first, "peer": second}, turns, uncounted=0)
    columns = values["ours"], values["peer"], ratios(values["ours"], values["peer"])
    return tuple(spread(column)["median"] for column in columns)


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--simulated_s", type=float, default=60.0, help="length of an episode of the TurtleBot3")
    parser.add_argument("--robots", nargs="+", choices=tuple(CONFIGS), default=list(CONFIGS))
    parser.add_argument("--n_envs", type=int, nargs="+", default=[1, 32, 64], help="only cases of so many simulations")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    table = Table(title="bhd-record", title_justify="left")
    for heading in ("measured", "ours", "peer", "peer is", "ratio", "goal"):
        table.add_column(heading, justify="left" if heading in ("measured", "peer is") else "right")
    missed = []

    def add(what: str, peer_is: str, values: tuple[float, float, float], goal: str, *, met: bool) -> None:
        mine, peer, ratio = values
        table.add_row(what, f"{mine:.0f}", f"{peer:.0f}", peer_is, f"{ratio:.2f}", goal)
        if not met:
            missed.append(what)

    length = {"turtlebot3": [f"--dataset.episode_time_s={options.simulated_s}"], "ur5": []}
    try:
        for robot, n, episodes, goal in CASES:
            if robot not in options.robots or n not in options.n_envs:
                continue
            real_time(folder, robot, n, n, *length[robot])
            ours = partial(real_time, folder, robot, n, episodes, *length[robot])
            values = paired(ours, partial(bare_step, robot, n), options.repeats)
            peer_is = "Batch.step and lidar alone" if robot == "turtlebot3" else "Batch.step alone"
            what = f"{robot}, n_envs = {n}: simulated s per s"
            add(what, peer_is, values, f">= {goal:.0f} x real time", met=values[0] >= goal)
        if "turtlebot3" in options.robots:
            try:

                def camera() -> float:
                    one = ("--robot.camera=true", "--n_envs=1", "--dataset.num_episodes=1", *length["turtlebot3"])
                    result = run_record(folder, "turtlebot3", *one)
                    return result.frames / result.wall_s

                frames = round(options.simulated_s * 10)
                values = paired(camera, lambda: encoded_images(folder, frames), 2 * options.repeats - 1)
                what, peer_is = "320x240 camera, 10 fps: frames per s", "MuJoCo's renderer and the same encoder"
                add(what, peer_is, values, f"ratio >= {CAMERA_GOAL}", met=values[2] >= CAMERA_GOAL)
                mine, peer = images(300)
                what, peer_is = "one 320x240 image: images per s", "MuJoCo's renderer, fastest settings"
                met = bool(mine / peer >= IMAGE_GOAL)
                add(what, peer_is, (mine, peer, mine / peer), f"ratio >= {IMAGE_GOAL}, the same time", met=met)
            except RenderingError as error:
                print(f"Camera not measured: {error}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    Console(width=140).print(table)
    if missed:
        print(f"Missed: {', '.join(missed)}")
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
