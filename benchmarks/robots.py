"""`bhd-record` beside `lerobot-record`, with the same mock robot, leader and cameras: `python -m benchmarks.robots`.

A robot of three joints that answers after 2 ms, two cameras of 640 x 480 that capture on threads of their own, and a
leader that is moved in a sine: the devices of the tests, `tests/robots/external/mock_devices`. Both commands encode
while they record, each with its own default encoder: H.264 here, AV1 there. They take turns; the robot itself notes
when it is observed. Printed are the cadence error (how far an interval between two observations is from 1 / fps, 99 %
quantile), processor time per recorded frame (of two lengths, so that the start is not in it), the time between two
episodes, and frames that were left out. With ``--kills N``, episodes that load after SIGKILL at N moments; with
``--minutes M``, the memory after M minutes against that after one. Exits with 3 if a goal is missed.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.stock import LeRobotDataset

_ROOT = Path(__file__).resolve().parents[1]
_DEVICES = "tests.robots.external.mock_devices"
_COMMANDS = {"bhd": "bhd_lerobot.cli.record", "stock": "lerobot.scripts.lerobot_record"}
GOALS = {"cadence": 1 / 3, "processor": 1 / 2, "between": 1 / 4}
"""Of stock's, at most."""


@dataclass(frozen=True)
class Run:
    """What one command did: times of its observations [ns], and its processor time [s]."""

    times: NDArray[np.int64]
    processor_s: float

    def cadence_error(self, fps: int) -> float:
        """Return the 99 % quantile of how far intervals within episodes are from 1 / fps [s]."""
        intervals = np.diff(self.times) / 1e9
        return float(np.quantile(np.abs(intervals[intervals < _GAP_S] - 1 / fps), 0.99))


_GAP_S = 0.25  # a longer interval is between two episodes, or is lost


def arguments(kind: str, fps: int, seconds: float, episodes: int, folder: Path) -> list[str]:
    """Return the command line of `bhd-record` or of `lerobot-record`."""
    camera = f"{{type: mock_camera, width: 640, height: 480, fps: {fps}}}"
    common = [
        f"--robot.discover_packages_path={_DEVICES}",
        "--robot.type=mock_arm",
        f"--robot.cameras={{front: {camera}, wrist: {camera}}}",
        f"--robot.times={folder}/times",
        f"--robot.calibration_dir={folder}",
        "--teleop.type=mock_leader",
        f"--teleop.calibration_dir={folder}",
        "--dataset.repo_id=bench/robots",
        f"--dataset.root={folder}/data",
        f"--dataset.fps={fps}",
        f"--dataset.num_episodes={episodes}",
        f"--dataset.episode_time_s={seconds:g}",
        "--dataset.reset_time_s=0",
    ]
    if kind == "bhd":
        return [*common, "--task.instruction=wave", f"--output_dir={folder}/run", "--estop_key=false"]
    return [
        *common,
        "--dataset.single_task=wave",
        "--dataset.push_to_hub=false",
        "--dataset.streaming_encoding=true",
        "--dataset.encoder_threads=1",
        "--play_sounds=false",
    ]


def start(kind: str, fps: int, seconds: float, episodes: int, folder: Path) -> "subprocess.Popen[bytes]":
    """Start a command."""
    main = f"import sys; from {_COMMANDS[kind]} import main; sys.exit(main())"
    own = {"PYTHONPATH": str(_ROOT), "HF_HUB_OFFLINE": "1", "HF_LEROBOT_HOME": str(folder / "home")}
    with (folder / "log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-c", main, *arguments(kind, fps, seconds, episodes, folder)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, **own},
        )


def run(kind: str, fps: int, seconds: float, episodes: int) -> Run:
    """Record, and return what the robot noted."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process = start(kind, fps, seconds, episodes, folder)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{kind} ended with {process.returncode}:\n{(folder / 'log').read_text()[-2000:]}")
        times = np.array((folder / "times").read_text().split(), np.int64)
        return Run(times, usage.ru_utime + usage.ru_stime)


def measure(kind: str, fps: int, seconds: float) -> dict[str, float]:
    """Return what is compared, of one command."""
    short, long = run(kind, fps, 3, 1), run(kind, fps, seconds, 1)
    double = run(kind, fps, 4, 2)
    intervals = np.diff(long.times) / 1e9
    return {
        "cadence": long.cadence_error(fps),
        "processor": (long.processor_s - short.processor_s) / (len(long.times) - len(short.times)),
        "between": float(np.diff(double.times).max() / 1e9),
        "left out": float((np.round(intervals * fps) - 1).clip(min=0).sum()),
        "frames": float(len(long.times)),
    }


def killed(count: int) -> tuple[int, int]:
    """Kill `bhd-record` at so many moments; return how many episodes it had saved, and how many stock LeRobot loads."""
    saved = loaded = 0
    rng = np.random.default_rng(0)
    for _ in range(count):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            process = start("bhd", 30, 0.5, 100, folder)
            info = folder / "data" / "meta" / "info.json"
            while not info.is_file() or not dataset_info(folder / "data").episodes:
                if process.poll() is not None:
                    raise RuntimeError((folder / "log").read_text()[-2000:])
                time.sleep(0.02)
            time.sleep(rng.uniform(0, 2))
            process.send_signal(signal.SIGKILL)
            process.wait()
            saved += len(dataset_info(folder / "data").episodes)
            dataset = LeRobotDataset("bench/robots", root=folder / "data", video_backend="pyav")
            ends = [int(episode["dataset_to_index"]) - 1 for episode in dataset.meta.episodes]
            loaded += sum(dataset[end]["observation.images.front"].ndim == 3 for end in ends)
    return saved, loaded


def memory(minutes: float) -> tuple[float, float]:
    """Return the memory of `bhd-record` and its encoders after a minute, and after so many [bytes]."""
    import psutil

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process = start("bhd", 30, 20, 1000, folder)
        began, used = time.monotonic(), []
        for until in (60.0, 60 * minutes):
            time.sleep(max(0.0, began + until - time.monotonic()))
            tree = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
            used.append(sum(one.memory_info().rss for one in tree))
        process.send_signal(signal.SIGTERM)
        process.wait()
    return used[0], used[1]


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20, help="length of the episode that is measured [s]")
    parser.add_argument("--rounds", type=int, default=3, help="how often the two take turns")
    parser.add_argument("--minutes", type=float, default=0, help="also measure memory for so long [min]")
    parser.add_argument("--kills", type=int, default=0, help="also kill it at so many moments")
    options = parser.parse_args()
    is_missed = False
    for fps in (30, 60):
        found: dict[str, list[dict[str, float]]] = {kind: [] for kind in _COMMANDS}
        for _ in range(options.rounds):
            for kind, runs in found.items():
                runs.append(measure(kind, fps, options.seconds))
        medians = {
            kind: {key: float(np.median([one[key] for one in runs])) for key in runs[0]} for kind, runs in found.items()
        }
        for key, goal in GOALS.items():
            ratio = medians["bhd"][key] / medians["stock"][key]
            is_missed |= ratio > goal
            print(
                f"{fps} fps, {key}: {1e3 * medians['bhd'][key]:.2f} ms, stock {1e3 * medians['stock'][key]:.2f} ms: "
                f"{ratio:.2f} of it, goal {goal:.2f}"
            )
        for kind in _COMMANDS:
            found_here = medians[kind]
            print(f"{fps} fps, {kind}: {found_here['left out']:.0f} of {found_here['frames']:.0f} frames left out")
        is_missed |= medians["bhd"]["left out"] > 0
    if options.kills:
        saved, loaded = killed(options.kills)
        print(f"SIGKILL at {options.kills} moments: {loaded} of {saved} saved episodes load")
        is_missed |= loaded < saved
    if options.minutes:
        first, last = memory(options.minutes)
        sizes = f"{last / 2**20:.0f} MiB, after one {first / 2**20:.0f}: {last / first:.2f} of it"
        print(f"memory after {options.minutes:g} min: {sizes}, goal 1.10")
        is_missed |= last > 1.1 * first
    return 3 if is_missed else 0


if __name__ == "__main__":
    sys.exit(main())
