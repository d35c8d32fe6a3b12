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
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks._renderer import speeds
from benchmarks._report import Report, parse_options
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.tasks.pick import PickConfig, PickTask

CAMERAS, SIZE = ("scene", "wrist"), 96
BATCH = 32
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


def training(report: Report, folder: Path, policy: str, options: argparse.Namespace) -> None:
    """Add the rows of samples a second of processor time of both programs."""
    root, steps, short = record(folder, policy, options.episodes), options.steps, options.steps // 5
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(options.turns):
        for program in PROGRAMS:
            for count in (steps,) if options.whole else (short, steps):
                seconds = processor_time(program, policy, root, folder / "run", count)
                times.setdefault((program, count), []).append(seconds)

    def compare(part: str, samples: int, times: dict[str, np.ndarray], goal: float | None) -> None:
        rates = {program: (samples * BATCH / took).tolist() for program, took in times.items()}
        what = f"learning {policy} from images, {part}"
        report.compare(what, "samples per CPU second", rates, ["lerobot-train"], goal=goal)

    whole = {program: np.array(times[program, steps]) for program in PROGRAMS}
    compare(f"a run of {steps} steps", steps, whole, TRAIN_GOAL)
    if not options.whole:
        alone = {program: took - np.array(times[program, short]) for program, took in whole.items()}
        compare("its steps alone", steps - short, alone, None)


def turn(qpos: np.ndarray, frame: int) -> None:
    """Turn the arm a little."""
    qpos[0] = 0.001 * frame


def main() -> int:
    """Print the table; return 3 if a goal was missed."""
    policies = list(RECORDINGS)
    options = parse_options(
        __doc__,
        policies={"nargs": "+", "choices": policies, "default": policies, "help": "which of them learn"},
        episodes=40,
        steps=(500, "of the longer training; the shorter has a fifth"),
        turns=3,
        whole=(False, "whole trainings only, not the speed of their steps alone"),
    )
    report = Report("Images")
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    try:
        for policy in options.policies:
            training(report, folder, policy, options)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    simulation = UR5Simulation(UR5Config())
    simulation.reset(np.zeros(1, int), [PickTask(PickConfig(), 1, 25).sample(0)], [0])
    try:
        rates = speeds(simulation, (SIZE, SIZE), CAMERAS, turn, 100 * options.turns)
        what = f"two cameras of {SIZE} x {SIZE}"
        report.compare(what, "images/s", rates, ["MuJoCo's renderer"], goal=RENDER_GOAL)
    except RenderingError as error:
        print(f"Rendering not measured: {error}")
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
