"""How punctual the robots' control loop is on the wall clock: `make bench-realtime`.

The TurtleBot3 ticks at 200 Hz and the UR5, with the objects of the pick task on its table, at 1 kHz. Four loops take
turns in blocks of some seconds, quiet and under CPU load on every core: a C++ loop and a plain Python loop in this
process, each on an absolute grid with the same physics and nothing else; the robot as it is, driven by a brain; and the
UR5 with two cameras, a torch brain that looks at them, and video that is encoded meanwhile. One table shows the
lateness of the ticks, how long they take, and behind every time its ratio to that of a peer in the neighbouring block.
Ticks that were missed are counted, and what the system refused is printed. Exits with 3 if a goal is missed, with 2 if
nothing could be measured.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks._turns import ratios, status, write
from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.datasets.format.features import dataset_features
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.policies.baselines import RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings, SystemCalls
from bhd_lerobot.registry import make_robot, make_simulation, robot_configs
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask

RATES = {"turtlebot3": 200, "ur5": 1000}  # control ticks and physics steps a second [Hz]
CONDITIONS = ("quiet", "load")
TWIN, PYTHON, OURS, VIDEO = "C++ twin", "plain Python", "bhd-lerobot", "bhd-lerobot, torch and video"
TIMES = ("wake_p50", "wake_p99", "wake_max", "tick_p99")
# The largest good values: of a ratio to the peer, and of the share of a period that a tick takes.
GOALS = ((OURS, "wake_p50", 1.2), (OURS, "wake_p99", 1.5), (OURS, "share", 0.25), (VIDEO, "tick_p99", 1.5))
WARM_UP_S = 0.3  # at the beginning of each block, not counted
LATE_NS = 100_000  # a tenth of the period of a loop at 1 kHz
SEED = 1
BUSY = 0.05  # share of the processors; above it the machine is not idle

Load = Callable[[], Any]


class NotMeasuredError(Exception):
    """A loop cannot be measured here; the message says why."""


# --- arithmetic -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ticks:
    """The ticks of a block.

    Attributes:
        times: when each was due, started and ended, on one clock [ns], shape (ticks, 3).
        period_ns: distance of the points of the grid [ns].
        refused: what the system refused to the loop.
    """

    times: NDArray[np.int64]
    period_ns: int
    refused: tuple[str, ...] = ()


def summarise(ticks: Ticks, warm_up_s: float = WARM_UP_S) -> dict[str, float]:
    """Return what a block shows; times in microseconds.

    ``wake_…`` is the lateness of the starts, ``tick_p99`` the duration of a tick and ``share`` that of a period.
    ``late`` counts ticks that started more than `LATE_NS` after they were due, ``missed`` points of the grid without a
    tick.

    Raises:
        NotMeasuredError: no tick is left after the warm-up, or ticks were not due on the grid.
    """
    due = ticks.times[:, 0]
    if np.any(np.diff(due) % ticks.period_ns) or np.any(np.diff(due) <= 0):
        raise NotMeasuredError("the loop left its grid")
    times = ticks.times[due - due[:1] >= warm_up_s * 1e9]
    if not len(times):
        raise NotMeasuredError(f"no tick came after the warm-up of {warm_up_s:g} s")
    due, started, ended = times.T
    wake_p50, wake_p99, wake_max = np.percentile(started - due, (50, 99, 100)) / 1e3
    tick_p99 = np.percentile(ended - started, 99) / 1e3
    return {
        "wake_p50": float(wake_p50),
        "wake_p99": float(wake_p99),
        "wake_max": float(wake_max),
        "tick_p99": float(tick_p99),
        "share": float(tick_p99 * 1e3 / ticks.period_ns),
        "ticks": len(times),
        "late": int(np.count_nonzero(started - due > LATE_NS)),
        "missed": int((due[-1] - due[0]) // ticks.period_ns + 1 - len(times)),
    }


def walk(
    tick: Callable[[], object],
    period_ns: int,
    points: int,
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], object] = time.sleep,
) -> NDArray[np.int64]:
    """Tick on an absolute grid; on overrun the phase stays, and the points that have passed are skipped.

    Args:
        tick: what to do.
        period_ns: the grid's period [ns].
        points: points of the grid.
        now: the clock [ns].
        sleep: waits for a number of seconds.

    Returns:
        When each tick was due, started and ended [ns], shape (ticks, 3).
    """
    times = np.zeros((points, 3), np.int64)
    start, point, executed = now() + period_ns, 0, 0
    while point < points:
        due = start + point * period_ns
        wait = due - now()
        if wait > 0:
            sleep(wait * 1e-9)
        started = now()
        tick()
        ended = now()
        times[executed] = due, started, ended
        executed += 1
        point = max(point + 1, (ended - start) // period_ns + 1)
    return times[:executed]


def find(blocks: Sequence[dict[str, Any]], robot: str, loop: str, condition: str) -> dict[int, dict[str, Any]]:
    """Return the blocks of a loop of a robot under a condition, by their round."""
    wanted = (robot, loop, condition)
    return {block["round"]: block for block in blocks if (block["robot"], block["loop"], block["condition"]) == wanted}


def ratio(ours: dict[int, dict[str, Any]], theirs: dict[int, dict[str, Any]], key: str) -> float | None:
    """Return the median of the ratios of blocks of the same round; None if no round has both.

    The median of the ratios, not the ratio of the medians: a noisy neighbour disturbs both of a pair.
    """
    rounds = sorted(ours.keys() & theirs.keys())
    found = ratios([ours[number][key] for number in rounds], [theirs[number][key] for number in rounds])
    return statistics.median(found) if found else None


# --- loops ------------------------------------------------------------------------------------------------------------


def configuration(robot: str, **options: Any) -> Any:
    """Return the configuration of a robot at the benchmark's rates."""
    return robot_configs()[robot](control_hz=RATES[robot], physics_hz=RATES[robot], **options)  # type: ignore[call-arg]


def make_task(robot: str, fps: int, seconds: float = 60.0) -> Any:
    """Return the task that a robot has: where it stands, and how long."""
    if robot == "turtlebot3":
        return AvoidTask(AvoidConfig(duration_s=seconds), 1, fps)
    return PickTask(PickConfig(duration_s=seconds), 1, fps)


def settled(robot: str) -> Any:
    """Return the physics of a robot in its scene, holding its posture; what stands on the table has settled."""
    config = configuration(robot)
    simulation = make_simulation(config, 1, 1)
    simulation.reset(np.zeros(1, np.intp), [make_task(robot, config.fps).sample(SEED)], [SEED])
    simulation.world.step(RATES[robot] // 5)
    return simulation.world


def run_python(robot: str, seconds: float, load: Load) -> Ticks:
    """Measure a plain Python loop in this process, with the privileges of the robots' loop.

    But for locked memory: this process holds PyTorch, all of which would be read from the disk.
    """
    world, period_ns = settled(robot), 10**9 // RATES[robot]
    with load(), Privileges() as privileges:
        grants = privileges.acquire(RealtimeSettings(lock_memory=False))
        times = walk(world.step, period_ns, round(seconds * RATES[robot]))
    world.check()
    return Ticks(times, period_ns, tuple(f"{grant.name}: {grant.detail}" for grant in grants if not grant.granted))


def build_twin(folder: Path) -> Path:
    """Compile the C++ twin against the installed MuJoCo; return the program.

    Raises:
        NotMeasuredError: there is no compiler, or it does not compile.
    """
    compiler = shutil.which(os.environ.get("CXX") or "c++")
    if compiler is None:
        raise NotMeasuredError("there is no C++ compiler (Debian and Ubuntu: package g++; or name one in CXX)")
    library, program = Path(mujoco.__file__).parent, folder / "twin"
    shared = [str(path) for path in sorted(library.glob("libmujoco.so*"))[:1]]
    command = [compiler, "-O2", "-std=c++17", "-pthread", f"-I{library / 'include'}", "-o", str(program)]
    command += [str(Path(__file__).with_name("twin.cpp")), *shared, f"-Wl,-rpath,{library}"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.splitlines()
        raise NotMeasuredError(f"{compiler}: {next((line for line in lines if 'error' in line), lines[-1:])}")
    return program


def run_twin(robot: str, seconds: float, load: Load, folder: Path) -> Ticks:
    """Measure the C++ twin, which steps the same physics from the same state.

    Raises:
        NotMeasuredError: it cannot be built, or fails.
    """
    program, model, state, out = (folder / name for name in ("twin", "model.mjb", "state", "times"))
    if not program.exists():
        build_twin(folder)
    world, period_ns = settled(robot), 10**9 // RATES[robot]
    own = world.copy_model(0)
    data = mujoco.MjData(own)
    world.copy_into(0, own, data)
    mujoco.mj_saveModel(own, str(model), None)
    values = np.zeros(mujoco.mj_stateSize(own, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(own, data, values, mujoco.mjtState.mjSTATE_INTEGRATION)
    values.tofile(state)
    numbers = (period_ns, 1, round(seconds * RATES[robot]), RealtimeSettings().priority)
    with load():
        done = subprocess.run(
            [str(program), str(model), str(state), str(out), *map(str, numbers)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60 + 3 * seconds,
            check=False,
        )
    if done.returncode:
        raise NotMeasuredError(f"the C++ twin ended with status {done.returncode}: {done.stderr.strip()}")
    return Ticks(np.fromfile(out, np.int64).reshape(-1, 3), period_ns, tuple(done.stdout.splitlines()))


def run_robot(robot: str, seconds: float, load: Load, folder: Path | None = None) -> Ticks:
    """Measure the loop of a robot that a brain drives through an episode.

    Args:
        robot: its type.
        seconds: length of the episode [s].
        load: keeps the processors busy while it runs.
        folder: where video is written, which a brain with a network looks at; no cameras if None.

    Raises:
        NotMeasuredError: states were lost, or the episode ended early.
    """
    cameras = {"camera": True} if folder is not None else {}
    config = configuration(robot, id=f"bench-{os.getpid()}", clock="realtime", **cameras)
    with closing(make_robot(config)) as simulation:
        task = make_task(robot, config.fps, seconds)
        brain, open_images = RandomBrain(RandomConfig(scale=0.05)), None
        if folder is not None:
            brain, open_images = NetworkBrain(), make_recorder(simulation, task, config, folder).begin_episode
            simulation.start_rendering()
        with load():
            return drive(simulation, task, brain, seconds, open_images)


def drive(
    simulation: Any, task: Any, brain: Any, seconds: float, open_images: Callable[[], Any] | None = None
) -> Ticks:
    """Return the ticks of an episode of a live robot.

    Args:
        simulation: the robot.
        task: what it is to do.
        brain: what drives it.
        seconds: length of the episode [s].
        open_images: makes what takes the episode's images; nothing does if None.

    Raises:
        NotMeasuredError: states were lost, or the episode ended early.
    """
    loop = EpisodeLoop(simulation, task, brain)
    with watch(simulation.link.block) as states:
        episode = next(loop.run([EpisodeSpec(0, SEED)], open_images=open_images))
    if episode.writer is not None:
        episode.writer.discard()
    refused = tuple(f"{grant['name']}: {grant['detail']}" for grant in simulation.grants if not grant["granted"])
    if len(states) < 2 or episode.outcome.event.cause not in ("timeout", "success"):
        cause, robot = episode.outcome.event.cause, simulation.config.type
        raise NotMeasuredError(
            f"the episode of {robot} ended with {cause}, {len(states)} ticks. Where other programs keep the processors "
            "busy, a loop stops by itself; run this alone"
        )
    # The loop's warm-up, before the episode, was a segment of its own.
    due, started, ended, executed, _ = np.array([state for state in states if state[-1] == states[-1][-1]], np.int64).T
    if np.any(np.diff(executed) != 1):
        raise NotMeasuredError("states of the loop were overwritten before they were read")
    # A state says when the tick before it ended.
    times = np.stack((due[:-1], started[:-1], ended[1:]), axis=1)
    times = times[times[:, 0] - times[:1, 0] < seconds * 1e9]  # not what follows while a late brain ends its frame
    return Ticks(times, 10**9 // simulation.config.control_hz, refused)


@contextmanager
def watch(block: Any) -> Iterator[list[tuple[int, ...]]]:
    """Read every state that a robot publishes in the block, from a thread of its own."""
    states: list[tuple[int, ...]] = []
    reader, stop = RingReader(block.ring), threading.Event()

    def drain() -> None:
        is_last = False
        while not is_last:
            is_last = stop.wait(0.05)
            while (state := reader.read()) is not None:
                if state["tick"] >= 0:
                    names = ("due_ns", "start_ns", "ended_ns", "executed", "segment")
                    states.append(tuple(int(state[name]) for name in names))

    thread = threading.Thread(target=drain)
    thread.start()
    try:
        yield states
    finally:
        stop.set()
        thread.join()


class NetworkBrain(RandomBrain):
    """Moves at random, and runs an untrained network of torch of a real policy's size on what it sees."""

    def __init__(self) -> None:
        import torch
        from torch import nn

        super().__init__(RandomConfig(scale=0.05))
        self.uses_images = True
        torch.manual_seed(0)
        layers: list[nn.Module] = []
        for before, after, stride in ((3, 32, 4), (32, 64, 2), (64, 128, 2), (128, 256, 2)):
            layers += [nn.Conv2d(before, after, 3, stride, 1), nn.ReLU()]
        layers += [nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(256 * 16, 512), nn.ReLU(), nn.Linear(512, 7)]
        self._network = nn.Sequential(*layers).eval()

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return the actions, shape (1, actions)."""
        import torch

        images = np.concatenate(list(observation.images.values()))
        with torch.inference_mode():
            self._network(torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255)
        return super().act(observation)


def make_recorder(simulation: Any, task: Any, config: Any, folder: Path) -> DatasetRecorder:
    """Return a recorder of everything, with video."""
    images = dict.fromkeys(simulation.camera_names, (config.camera_height, config.camera_width, 3))
    physics = [f"physics_{index}" for index in range(simulation.physics_state.shape[1])]
    names = simulation.observation_names, simulation.action_names
    features = dataset_features(*names, images, physics, task.environment_names, effort_names=simulation.effort_names)
    root = Path(tempfile.mkdtemp(dir=folder)) / "data"
    return DatasetRecorder.create("bench/realtime", config.fps, features, robot_type=config.type, root=root)


# --- running ----------------------------------------------------------------------------------------------------------

_BUSY_CHILD = """
import os, sys
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # the AV1 encoder of a parent that is root raises it
os.sched_setaffinity(0, {int(sys.argv[1])})
while os.getppid() == int(sys.argv[2]):
    sum(range(9999))
"""


@contextmanager
def cpu_load() -> Iterator[None]:
    """Keep every core that this process may use busy, at the ordinary scheduling policy.

    Raises:
        RuntimeError: the load ended before its time, so that numbers would be wrong.
    """
    with ExitStack() as stack:
        children = []
        for core in sorted(os.sched_getaffinity(0)):
            command = [sys.executable, "-S", "-c", _BUSY_CHILD, str(core), str(os.getpid())]
            children.append(stack.enter_context(subprocess.Popen(command, stdin=subprocess.DEVNULL)))
            stack.callback(children[-1].kill)
        time.sleep(0.2)
        yield
        if any(child.poll() is not None for child in children):
            raise RuntimeError("The load ended before its time.")


def busy_share(seconds: float = 1.0) -> float:
    """Return the share of the processors that other programs use, watched for some seconds."""

    def read() -> NDArray[np.int64]:
        fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:9]
        return np.array(fields, np.int64)  # user nice system idle iowait irq softirq steal

    before = read()
    time.sleep(seconds)
    spent = read() - before
    return 1 - float(spent[3:5].sum() / max(1, spent.sum()))


Run = Callable[[str, float, Load], Ticks]


def measure(
    loops: Sequence[tuple[str, str, Run]], conditions: Sequence[str], rounds: int, seconds: float
) -> tuple[list[dict[str, Any]], dict[str, None]]:
    """Measure all loops in turns, every other round backwards; one that fails is left out from then on.

    Returns:
        The blocks, and what is to be said about loops: what was refused to them, or why they were not measured.
    """
    blocks: list[dict[str, Any]] = []
    notes: dict[str, None] = {}
    failed = set()
    for number in range(rounds):
        for condition in conditions:
            for robot, loop, run in loops if number % 2 == 0 else reversed(loops):
                if (robot, loop) in failed:
                    continue
                where = f"{robot}, {loop}"
                print(f"round {number + 1} of {rounds}, {condition}: {where}", file=sys.stderr, flush=True)
                load = cpu_load if condition == "load" else nullcontext
                try:
                    ticks = run(robot, seconds + WARM_UP_S, load)
                    found = summarise(ticks)
                except (NotMeasuredError, RealtimeError, subprocess.TimeoutExpired, OSError) as error:
                    failed.add((robot, loop))
                    notes[f"{where} was NOT MEASURED: {error}"] = None
                    continue
                notes.update({f"{where}: refused was {one}": None for one in ticks.refused})
                blocks.append({"robot": robot, "loop": loop, "condition": condition, "round": number, **found})
    return blocks, notes


def peer_of(blocks: Sequence[dict[str, Any]], robot: str, loop: str) -> str:
    """Return what a loop is compared with."""
    if loop == VIDEO:
        return OURS
    measured = {block["loop"] for block in blocks if block["robot"] == robot}
    return next((one for one in (TWIN, PYTHON) if one in measured and one != loop), "")


def rows(blocks: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each loop and condition: medians over the blocks, the overall maximum, sums, and ratios."""
    table = []
    for robot, loop, condition in dict.fromkeys(
        (block["robot"], block["loop"], block["condition"]) for block in blocks
    ):
        own = find(blocks, robot, loop, condition)
        peer = "" if loop == TWIN else peer_of(blocks, robot, loop)
        row: dict[str, Any] = {"robot": robot, "loop": loop, "condition": condition, "peer": peer}
        row |= {key: statistics.median(one[key] for one in own.values()) for key in (*TIMES, "share")}
        row["wake_max"] = max(one["wake_max"] for one in own.values())
        row |= {key: sum(one[key] for one in own.values()) for key in ("ticks", "late", "missed")}
        theirs = find(blocks, robot, peer, condition)
        row["ratios"] = {key: ratio(own, theirs, key) for key in TIMES}
        table.append(row)
    return table


def missed_goals(table: Sequence[dict[str, Any]]) -> list[str]:
    """Return the goals that were missed, in words."""
    found = []
    for loop, key, most in GOALS:
        for row in (one for one in table if one["loop"] == loop):
            value = row["share"] if key == "share" else row["ratios"][key]
            if value is not None and value > most:
                what = "tick_p99 ÷ period" if key == "share" else f"{key} ÷ {row['peer']}"
                found.append(f"{row['robot']}, {loop}, {row['condition']}: {what} is {value:.2f}, at most {most}")
    return found


def show(table: Sequence[dict[str, Any]], conditions: Sequence[str]) -> None:
    """Print the table."""
    view = Table(title="Punctuality: µs (ratio to the peer)", title_justify="left")
    for heading in ("robot", "loop", "while", "peer"):
        view.add_column(heading)
    for heading in ("wake p50", "wake p99", "wake max", "tick p99", "÷ period", "ticks", "late", "missed"):
        view.add_column(heading, justify="right", no_wrap=True)
    order = [*RATES, *conditions, TWIN, PYTHON, OURS, VIDEO]
    for row in sorted(table, key=lambda one: [order.index(one[key]) for key in ("robot", "condition", "loop")]):
        cells = [
            f"{row[key]:.1f}" + ("" if (times := row["ratios"][key]) is None else f" ({times:.2f})") for key in TIMES
        ]
        counts = [str(row[key]) for key in ("ticks", "late", "missed")]
        names = [escape(row[key]) for key in ("robot", "loop", "condition", "peer")]
        view.add_row(*names, *cells, f"{row['share']:.2f}", *counts)
    console = Console()
    (console if console.is_terminal else Console(width=160)).print(view)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 3 if a goal was missed, 2 if nothing was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.realtime", description=__doc__)
    parser.add_argument("--blocks", type=int, help="blocks for each loop and condition (default 6)")
    parser.add_argument("--seconds", type=float, help="length of a block [s] (default 10)")
    parser.add_argument("--robots", nargs="+", choices=tuple(RATES), default=list(RATES))
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--quick", action="store_true", help="1 block of 1 s; its numbers are not to be quoted")
    parser.add_argument("--json", type=Path, help="write the numbers to this file as well")
    options = parser.parse_args(arguments)
    blocks = (1 if options.quick else 6) if options.blocks is None else options.blocks
    seconds = (1.0 if options.quick else 10.0) if options.seconds is None else options.seconds
    if blocks < 1 or not 0 < seconds <= 3600:
        parser.error("--blocks must be at least 1, and --seconds more than 0 and at most 3600.")
    busy = busy_share()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bhd-bench-")))
        with suppress(OSError):  # for all loops alike; where it is refused they say so
            calls = SystemCalls()
            stack.callback(calls.close, calls.hold_cpu_latency(0))
        loops: list[tuple[str, str, Run]] = []
        for robot in options.robots:
            loops += [(robot, TWIN, lambda *one: run_twin(*one, folder)), (robot, PYTHON, run_python)]
            loops.append((robot, OURS, run_robot))
            if robot == "ur5":
                loops.append((robot, VIDEO, lambda *one: run_robot(*one, folder)))
        found, notes = measure(loops, options.conditions, blocks, seconds)
    if not found:
        print("Nothing was measured.", *notes, sep="\n", file=sys.stderr)
        return 2
    table = rows(found)
    missed = missed_goals(table)
    show(table, options.conditions)
    print(*(notes or ["Everything that the loops asked the system for was granted."]), sep="\n")
    if busy > BUSY:
        print(f"THE MACHINE IS NOT IDLE: before the run other programs used {busy:.0%} of the processors.")
    if blocks < 6 or seconds < 10:
        print("A SHORT RUN: these numbers are not to be quoted; that takes 6 blocks of 10 s.")
    print(*(f"GOAL MISSED: {one}" for one in missed), sep="\n" if missed else "", end="\n" if missed else "goals met\n")
    write(options.json, {"seconds": seconds, "busy": busy, "notes": list(notes), "rows": table, "blocks": found})
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
