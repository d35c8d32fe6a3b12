"""How punctual the robots' control loop is on the wall clock: `make bench-realtime`.

The TurtleBot3 ticks at 200 Hz and the UR5, with the objects of the pick task on its table, at 1 kHz, with position
servos and, only by `--robots=ur5_impedance`, with torque motors; or all at `--hz`. Three loops take turns in blocks of
some seconds, quiet and under CPU load on every core: a C++ loop on an absolute grid with the same physics and nothing
else; the robot as it is, driven by a brain; and the UR5 with two cameras, a torch brain that looks at them, and video
that is encoded meanwhile. The table shows the lateness of the ticks, how long they take, and behind every time its
ratio to that of a peer in the neighbouring block. Ticks that were missed are counted, and what the system refused is
printed. Exits with 3 if a goal is missed, with 2 if nothing could be measured.
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Report, parse_options
from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.datasets.format.features import dataset_features
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.policies.baselines import NoopBrain, RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.realtime.privileges import RealtimeSettings, SystemCalls
from bhd_lerobot.registry import make_robot, make_simulation, robot_configs
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask

RATES = {"turtlebot3": 200, "ur5": 1000, "ur5_impedance": 1000}  # control ticks and physics steps a second [Hz]
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "ur5_impedance": ("ur5", {"control": "impedance", "action_space": "tool", "tool_pose": True})
}
CONDITIONS = ("quiet", "load")
TWIN, OURS, VIDEO = "C++ twin", "bhd-lerobot", "bhd-lerobot, torch and video"
PEERS = {OURS: TWIN, VIDEO: OURS}
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
        act_times: how long each call of the brain took [s].
    """

    times: NDArray[np.int64]
    period_ns: int
    refused: tuple[str, ...] = ()
    act_times: tuple[float, ...] = ()


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


# --- loops ------------------------------------------------------------------------------------------------------------


def configuration(robot: str, **options: Any) -> Any:
    """Return the configuration of a robot at the benchmark's rates."""
    kind, own = VARIANTS.get(robot, (robot, {}))
    return robot_configs()[kind](control_hz=RATES[robot], physics_hz=RATES[robot], **own, **options)  # type: ignore[call-arg]


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
    for _ in range(config.fps // 5):
        simulation.step(None)
    return simulation.world


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
        brain: Any = NoopBrain() if robot in VARIANTS else RandomBrain(RandomConfig(scale=0.05))
        open_images = None
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
    refused = tuple(f"{grant['name']}: {grant['detail']}" for grant in simulation.clock.grants if not grant["granted"])
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
    return Ticks(times, 10**9 // simulation.config.control_hz, refused, tuple(loop.act_times))


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
    names = simulation.observation_names, simulation.action_names
    features = dataset_features(*names, simulation.camera_shapes, simulation.columns, task.environment_names)
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


def summarise_blocks(report: Report, blocks: Sequence[dict[str, Any]]) -> None:
    """Add the rows of each loop and condition: medians over the blocks, the overall maximum, sums, and ratios."""
    found: dict[tuple[str, str, str], dict[int, dict[str, Any]]] = {}
    for block in blocks:
        found.setdefault((block["robot"], block["loop"], block["condition"]), {})[block["round"]] = block
    for (robot, loop, condition), own in found.items():
        peer = PEERS.get(loop, "")
        theirs = found.get((robot, peer, condition), {})
        both = sorted(own.keys() & theirs.keys())
        # The median of the ratios, not the ratio of the medians: a noisy neighbour disturbs both of a pair.
        over = {
            key: statistics.median(own[number][key] / theirs[number][key] for number in both) if both else None
            for key in TIMES
        }
        middle = {key: statistics.median(one[key] for one in own.values()) for key in (*TIMES, "share")}
        middle["wake_max"] = max(one["wake_max"] for one in own.values())
        ticks, late, missed = (sum(one[key] for one in own.values()) for key in ("ticks", "late", "missed"))
        what = f"{robot} at {RATES[robot]} Hz, {loop}, {condition}"
        cells = [
            f"{key} {middle[key]:.1f} us" + ("" if (times := over[key]) is None else f" ({times:.2f} x)")
            for key in TIMES
        ]
        report.add(what + (f", over {peer}" if both else ""), "; ".join(cells))
        report.add(f"{what}: ticks", f"{ticks}, {late} late by over 0.1 ms, {missed} missed")
        for name, key, most in GOALS:
            value = middle["share"] if key == "share" else over[key]
            if loop == name and value is not None:
                words = "tick_p99 / period" if key == "share" else f"{key} / {peer}"
                report.add(f"{what}: {words}", f"{value:.2f}", f"at most {most}", met=value <= most)


def check_lengths(what: str, number: int, seconds: float) -> None:
    """End the program with status 2 if there is nothing to measure, or too much."""
    if number < 1 or not 0 < seconds <= 3600:
        print(f"--{what} must be at least 1, and --seconds more than 0 and at most 3600.", file=sys.stderr)
        sys.exit(2)


def add_conditions(report: Report, busy: float, notes: Iterable[str]) -> None:
    """Add rows of what was refused, and of other programs."""
    for note in notes:
        report.add(note, "")
    used = f"{100 * busy:.0f} % of the processors" + (": THE MACHINE IS NOT IDLE" if busy > BUSY else "")
    report.add("used by other programs before the run", used)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 3 if a goal was missed, 2 if nothing was measured."""
    options = parse_options(
        __doc__,
        arguments,
        blocks={"type": int, "help": "blocks for each loop and condition (default 6)"},
        seconds={"type": float, "help": "length of a block [s] (default 10)"},
        robots={"nargs": "+", "choices": tuple(RATES), "default": ["turtlebot3", "ur5"]},
        hz={"type": int, "help": "control ticks and physics steps a second [Hz] (default: each its own)"},
        conditions={"nargs": "+", "choices": CONDITIONS, "default": list(CONDITIONS)},
        quick=(False, "1 block of 1 s; its numbers are not to be quoted"),
    )
    blocks = (1 if options.quick else 6) if options.blocks is None else options.blocks
    seconds = (1.0 if options.quick else 10.0) if options.seconds is None else options.seconds
    check_lengths("blocks", blocks, seconds)
    if options.hz is not None:
        check_lengths("hz", options.hz, seconds)
        RATES.update(dict.fromkeys(RATES, options.hz))
    busy = busy_share()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bhd-bench-")))
        with suppress(OSError):  # for all loops alike; where it is refused they say so
            calls = SystemCalls()
            stack.callback(calls.close, calls.hold_cpu_latency(0))
        loops: list[tuple[str, str, Run]] = []
        for robot in options.robots:
            loops += [(robot, TWIN, partial(run_twin, folder=folder)), (robot, OURS, run_robot)]
            if robot == "ur5":
                loops.append((robot, VIDEO, partial(run_robot, folder=folder)))
        found, notes = measure(loops, options.conditions, blocks, seconds)
    if not found:
        print("Nothing was measured.", *notes, sep="\n", file=sys.stderr)
        return 2
    is_short = blocks < 6 or seconds < 10
    short = ". A short run: not to be quoted; that takes 6 blocks of 10 s" if is_short else ""
    report = Report(f"Punctuality: lateness of ticks, and how long they take{short}")
    summarise_blocks(report, found)
    add_conditions(report, busy, notes)
    report.numbers |= {"seconds": seconds, "busy": busy, "notes": list(notes), "blocks": found}
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
