"""Learning from images, beside stock `lerobot-train`, and rendering them: `python -m benchmarks.images`.

Training: the same policy, the same data as video, the same number of steps, one thread each. Two policies take turns:
`bhd_perception`, whose network is most of the work, on picks of a UR5 with two cameras; and `bhd_cnn`, a small network
that looks at several images in a row, on drives of a TurtleBot3. Samples a second of processor time, that of all
processes of a run counted together; once for a whole run, from the start of the program over reading and decoding to
the last checkpoint, and once for the steps alone: the difference between a long and a short run. (`--whole`: only the
former.)

Rendering: images of two cameras of 96 x 96 pixels, beside MuJoCo's own renderer in its fastest settings, in turns.
Exits with 3 if a goal is missed.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# MuJoCo's renderer takes its backend from here when it is imported; ours looks for one by itself.
os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._turns import in_turns, ratios, shown, spread, status, write
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.tasks.pick import PickConfig, PickTask

CAMERAS, SIZE = ("scene", "wrist"), 96
BATCH = 32
PARTS = {"whole": "a run of {} steps", "steps": "its steps alone"}
TRAIN_GOAL, RENDER_GOAL = 5.0, 0.8  # times the peer's speed
# What is recorded to learn each policy from, and with which further options.
RECORDINGS = {
    "bhd_perception": ("ur5_pick_camera", "--robot.camera_width=160", "--robot.camera_height=120", "--dataset.fps=10"),
    "bhd_cnn": ("turtlebot3_avoid_camera",),
}
PROGRAMS = {"bhd-train": "bhd_lerobot.cli.train", "lerobot-train": "lerobot.scripts.lerobot_train"}


def record(folder: Path, policy: str, episodes: int) -> Path:
    """Record what a policy learns from; return the dataset's folder."""
    root, (config, *more) = folder / "data", RECORDINGS[policy]
    shutil.rmtree(root, ignore_errors=True)
    options = [f"--dataset.root={root}", f"--dataset.num_episodes={episodes}", f"--output_dir={folder / 'recording'}"]
    command = ["bhd_lerobot.cli.record", f"--config_path=configs/record/{config}.yaml", *options, *more]
    subprocess.run([sys.executable, "-m", *command, "--preview_video=false"], check=True, capture_output=True)
    return root


def processor_time(program: str, policy: str, root: Path, output: Path, steps: int) -> float:
    """Return the processor time of a training, start and end included [s]."""
    shutil.rmtree(output, ignore_errors=True)
    options = {
        "dataset.repo_id": f"bhd/{RECORDINGS[policy][0]}",
        "dataset.root": root,
        "dataset.use_imagenet_stats": "false",
        "policy.type": policy,
        "policy.device": "cpu",
        "policy.push_to_hub": "false",
        "output_dir": output,
        "batch_size": BATCH,
        "steps": steps,
        "save_freq": steps,
        "log_freq": steps,
        "env_eval_freq": 0,
        "num_workers": 1,
        "dataset.video_backend": "pyav",
    }
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", PROGRAMS[program], *(f"--{key}={value}" for key, value in options.items())]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{program} ended with status {done.returncode}:\n{done.stderr[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def training(
    folder: Path, policy: str, episodes: int, steps: int, *, turns: int, parts: Sequence[str]
) -> dict[str, Any]:
    """Return samples a second of processor time of both programs, in each part of `PARTS`, and their ratios."""
    root = record(folder, policy, episodes)
    runs: dict[tuple[str, int], list[float]] = {}
    counts = {"whole": (steps,), "steps": (steps // 5, steps)}
    for _ in range(turns):
        for program in PROGRAMS:
            for count in sorted({count for part in parts for count in counts[part]}):
                seconds = processor_time(program, policy, root, folder / "run", count)
                runs.setdefault((program, count), []).append(seconds)
    found: dict[str, Any] = {"episodes": episodes, "steps": steps, "batch_size": BATCH}
    for what in parts:
        rates, samples = {}, (steps if what == "whole" else steps - steps // 5) * BATCH
        for program in PROGRAMS:
            short = np.array(runs[program, steps // 5]) if what == "steps" else 0.0
            rates[program] = (samples / (np.array(runs[program, steps]) - short)).tolist()
            found[f"{what}: {program}"] = spread(rates[program])
        found[f"{what}: ratio"] = spread(ratios(rates["bhd-train"], rates["lerobot-train"]))
    return found


def rendering(frames: int, turns: int) -> dict[str, Any]:
    """Return images a second of our camera and of MuJoCo's own renderer, two cameras a frame, taken in turns."""
    simulation = UR5Simulation(UR5Config())
    simulation.reset(np.zeros(1, int), [PickTask(PickConfig(), 1, 25).sample(0)], [0])
    camera = Camera(simulation.world, SIZE, SIZE)
    model = simulation.world.copy_model(0)
    data = mujoco.MjData(model)
    simulation.world.copy_into(0, model, data)
    renderer = mujoco.Renderer(model, SIZE, SIZE)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
        renderer.scene.flags[flag] = False
    option = mujoco.MjvOption()
    option.geomgroup[:] = [1, 1, 0, 0, 0, 0]
    joint = simulation.world.qpos[0, 0]

    def ours() -> float:
        started = time.perf_counter()
        for frame in range(frames):
            simulation.world.qpos[0, 0] = joint + 0.001 * frame
            for name in CAMERAS:
                camera.render(0, name)
        return len(CAMERAS) * frames / (time.perf_counter() - started)

    def bare() -> float:
        started = time.perf_counter()
        for frame in range(frames):
            data.qpos[0] = joint + 0.001 * frame
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            for name in CAMERAS:
                renderer.update_scene(data, name, option)
                renderer.render()
        return len(CAMERAS) * frames / (time.perf_counter() - started)

    values = in_turns({"ours": ours, "bare": bare}, turns)
    camera.close()
    renderer.close()
    found = {name: spread(one) for name, one in values.items()}
    return {**found, "ratio": spread(ratios(values["ours"], values["bare"]))}


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    policies = list(RECORDINGS)
    parser.add_argument("--policies", nargs="+", choices=policies, default=policies, help="which of them learn")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--steps", type=int, default=500, help="of the longer training; the shorter has a fifth")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--whole", action="store_true", help="whole trainings only, not the speed of their steps alone")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results: dict[str, Any] = {}
    table = Table(title="Images", title_justify="left")
    for heading in ("measured", "ours", "peer", "peer is", "ratio", "goal"):
        table.add_column(heading, justify="left" if heading in ("measured", "peer is") else "right")
    missed = []
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    results["training"] = {}
    try:
        for policy in options.policies:
            parts = list(PARTS)[: 1 if options.whole else None]
            found = training(folder, policy, options.episodes, options.steps, turns=options.turns, parts=parts)
            results["training"][policy] = found
            for what in parts:
                label = f"{policy}, {PARTS[what].format(options.steps)}: samples per CPU s"
                goal = f">= {TRAIN_GOAL:g}" if what == "whole" else ""
                both = (shown(found[f"{what}: {program}"], ".1f") for program in PROGRAMS)
                table.add_row(label, *both, "lerobot-train", shown(found[f"{what}: ratio"]), goal)
            if found["whole: ratio"]["median"] < TRAIN_GOAL:
                missed.append(f"training {policy}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    try:
        results["rendering"] = found = rendering(100, 2 * options.turns + 1)
        label, peer = f"two cameras of {SIZE} x {SIZE}: images per s", "MuJoCo's renderer, fastest settings"
        ratio = shown(found["ratio"])
        table.add_row(label, shown(found["ours"], ".0f"), shown(found["bare"], ".0f"), peer, ratio, f">= {RENDER_GOAL}")
        if found["ratio"]["median"] < RENDER_GOAL:
            missed.append("rendering")
    except RenderingError as error:
        print(f"Rendering not measured: {error}")
    Console(width=150).print(table)
    write(options.json, json.loads(json.dumps(results)))
    if missed:
        print(f"Missed: {', '.join(missed)}")
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
