"""Does a brain that looks through a camera keep the cerebellum waiting? `python -m benchmarks.sight`.

A UR5 on the wall clock, 500 ticks and 25 frames a second, before the table of the pick task. Three brains take turns in
blocks of some seconds: `noop`, which sees nothing; `bhd_perception`, which gets two rendered images in every frame and
finds the objects in one of them; and `bhd_pixels`, which sees an episode's first image and predicts in every frame. The
brain's process, with all that renders and infers, is pinned to one core. The cerebellum, SCHED_FIFO in a process of its
own, runs on another core, as one would set it up, and in a second series on the same one, which is harder: there it has
to take the core from the inference.

The weights are not trained, unless checkpoints are named. What a network costs does not depend on its weights, but what
becomes of its answers does: the threshold of the untrained perception is set so that it finds five objects, as many as
there can be. Lateness of ticks, ticks later than 0.1 ms, missed ticks, frames a second and the brain's processor time
per frame are printed, lateness with its ratio to that of `noop` in the same round. A block in which the robot was
stopped, because other programs or the host of a virtual machine held up its loop, is run again and counted; beside a
brain that may not happen more often than beside `noop`. Exits with 3 if a goal is missed, with 2 if nothing could be
measured.
"""

import logging
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray
from torch.nn import functional

from benchmarks._report import Report, parse_options
from benchmarks._turns import ratios
from benchmarks.realtime import (
    SEED,
    WARM_UP_S,
    NotMeasuredError,
    add_conditions,
    busy_share,
    check_lengths,
    drive,
    make_task,
    summarise,
)
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS
from bhd_lerobot.errors import BhdError
from bhd_lerobot.policies.baselines import NoopBrain
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.perception.configuration_perception import LABELS, PerceptionConfig
from bhd_lerobot.policies.perception.modeling_perception import PerceptionPolicy
from bhd_lerobot.policies.perception.perceiver import Perceiver, PerceptionOptions
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig
from bhd_lerobot.policies.pixels.modeling_pixels import PixelsPolicy
from bhd_lerobot.registry import make_robot, make_simulation
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.sim.camera import Camera

WIDTH, HEIGHT = 320, 240
NOOP, PERCEPTION, PIXELS = BRAINS = ("noop", "bhd_perception", "bhd_pixels")
BESIDE, SAME = CORES = ("its own core", "the brain's core")
TIMES = ("wake_p50", "wake_p99", "tick_p99")
KEYS = (*TIMES, "late_share", "frames_per_s", "cpu_ms", "inference_p50", "inference_p99")
GOALS = {
    "wake_p99": 1.5,  # largest ratio of lateness to that beside `noop`
    "late_share": 0.001,  # by which the share of late ticks may exceed that beside `noop`
    "frames_per_s": 0.99,  # least share of the frames
}
ATTEMPTS = 3  # that a block gets to come to its end
_STD = 0.005  # [rad] and [m] the untrained policy's actions stay so near to where the arm is


# --- brains -----------------------------------------------------------------------------------------------------------


class LookingBrain(NoopBrain):
    """Holds still, and finds the objects in the image of every frame.

    Attributes:
        found: how many it found, frame by frame.

    Args:
        path: the checkpoint of a `bhd_perception`.
    """

    uses_images = True

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._perceiver = Perceiver(PerceptionOptions(str(path)))
        self.found: list[int] = []

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return the actions that hold, shape (1, actions)."""
        self.found.append(len(self._perceiver.look(observation.images, 0)))
        return super().act(observation)


def features(action: int) -> dict[str, Any]:
    """Return the features of a policy that looks at images of the scene camera."""
    return {
        "input_features": {
            "observation.images.scene": PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (2 * action,)),
            OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (len(LABELS),)),
        },
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (action,))},
        "device": "cpu",
    }


def first_look() -> tuple[torch.Tensor, NDArray[np.float64]]:
    """Return an image of a table, shape (1, 3, height, width), 0 to 1, and the robot's state there."""
    config = UR5Config()
    simulation = make_simulation(config, 1, 1)
    simulation.reset(np.zeros(1, np.intp), [make_task("ur5", config.fps).sample(SEED)], [SEED])
    with closing(Camera(simulation.world, WIDTH, HEIGHT)) as camera:
        image = camera.render(0, "scene")
    return torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255, simulation.observe().state[0]


def untrained_perception(folder: Path, image: torch.Tensor) -> Path:
    """Write a perception that has learned nothing, and finds as many objects as there can be; return its folder."""
    torch.manual_seed(0)
    policy = PerceptionPolicy(PerceptionConfig(**features(7))).eval()
    policy.factor.fill_(1.0)
    with torch.no_grad():
        presence = policy.look(image)[1]["presence"]
        highest = functional.max_pool2d(presence[:, None], 5, stride=1, padding=2)[:, 0]
        peaks = presence[presence == highest].sort(descending=True).values
        least = policy.config.least_presence
        last = policy.network.answer[-1]
        last.bias[0] += math.log(least / (1 - least)) - peaks[MAX_OBJECTS - 1 : MAX_OBJECTS + 1].mean()
    save(policy, folder, {})
    return folder


def untrained_pixels(folder: Path, state: NDArray[np.float64]) -> Path:
    """Write a policy that has learned nothing, and moves the arm little; return its folder."""
    torch.manual_seed(0)
    action = len(state) // 2
    config = PixelsConfig(**features(action), n_action_steps=1, ignored_columns=list(range(action, 2 * action)))
    middle = torch.from_numpy(state).float()
    stats = {
        OBS_STATE: {"mean": middle, "std": torch.ones(2 * action)},
        ACTION: {"mean": middle[:action], "std": torch.full((action,), _STD)},
    }
    save(PixelsPolicy(config), folder, stats)
    return folder


def save(policy: Any, folder: Path, stats: dict[str, Any]) -> None:
    """Write a policy and its processors."""
    policy.save_pretrained(folder)
    for steps in make_pre_post_processors(policy.config, dataset_stats=stats):
        steps.save_pretrained(folder)


# --- blocks -----------------------------------------------------------------------------------------------------------


@contextmanager
def pinned(core: int) -> Iterator[None]:
    """Keep this process, all of its threads and those to come, on one core for a while."""
    before = os.sched_getaffinity(0)
    _pin({core})
    try:
        yield
    finally:
        _pin(before)


def _pin(cores: set[int]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread.name), cores)


def block(name: str, cores: tuple[int, int], seconds: float, checkpoints: dict[str, Path]) -> dict[str, Any]:
    """Return what a block of one brain shows; times in microseconds, those of the brain in milliseconds.

    Args:
        name: of the brain.
        cores: the brain's, and the cerebellum's.
        seconds: length of the episode [s].
        checkpoints: of the brains that have one.

    Raises:
        NotMeasuredError: the episode ended early, or states were lost.
    """
    brain: Any = NoopBrain()
    if name == PERCEPTION:
        brain = LookingBrain(checkpoints[name])
    elif name == PIXELS:
        brain = LearnedBrain(LearnedBrainConfig(str(checkpoints[name]), n_action_steps=1))
    config = UR5Config(
        id=f"bench-{os.getpid()}",
        clock="realtime",
        camera=True,
        camera_width=WIDTH,
        camera_height=HEIGHT,
        # On a core that is busy what reads the states may fall behind by as much as the episode is long.
        realtime=RealtimeConfig(affinity=[cores[1]], buffer_s=seconds + 10.0),
    )
    with closing(make_robot(config)) as robot, pinned(cores[0]):
        task = make_task("ur5", config.fps, seconds)
        robot.start_rendering()  # before the first episode, as `bhd-record` and `bhd-eval` do
        used = time.process_time()
        ticks = drive(robot, task, brain, seconds)
        used = time.process_time() - used
    decisions = np.array(ticks.act_times)
    found = {
        **summarise(ticks),
        "frames_per_s": len(decisions) / seconds,
        "cpu_ms": 1e3 * used / len(decisions),
        "inference_p50": 1e3 * float(np.median(decisions)),
        "inference_p99": 1e3 * float(np.percentile(decisions, 99)),
        "objects": statistics.mean(brain.found) if isinstance(brain, LookingBrain) else None,
        "refused": list(ticks.refused),
    }
    return {**found, "late_share": found["late"] / found["ticks"]}


def measure(rounds: int, seconds: float, checkpoints: dict[str, Path]) -> list[dict[str, Any]]:
    """Measure all brains with the cerebellum on both cores, in turns, every other round backwards.

    Raises:
        NotMeasuredError: a block came to no end in any of its attempts.
    """
    first, *others = sorted(os.sched_getaffinity(0))
    places = {SAME: (first, first), **({BESIDE: (first, others[-1])} if others else {})}
    cases = [(where, name) for where in places for name in BRAINS]
    blocks = []
    for number in range(rounds):
        for where, name in cases if number % 2 == 0 else reversed(cases):
            print(f"round {number + 1} of {rounds}: {name}, cerebellum on {where}", file=sys.stderr, flush=True)
            found, stops = attempt(partial(block, name, places[where], seconds + WARM_UP_S, checkpoints))
            blocks.append({"round": number, "core": where, "brain": name, "stops": stops, **found})
    return blocks


def attempt(run: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], int]:
    """Return what the first block that comes to its end shows, and how many did not before it.

    Raises:
        NotMeasuredError: none of `ATTEMPTS` did.
    """
    for stops in range(ATTEMPTS):
        try:
            return run(), stops
        except NotMeasuredError as error:
            print(f"attempt {stops + 1} of {ATTEMPTS}: {error}", file=sys.stderr, flush=True)
            last = error
    raise last


# --- results ----------------------------------------------------------------------------------------------------------


def summarise_blocks(report: Report, blocks: Sequence[dict[str, Any]], fps: int = 25) -> None:
    """Add the rows of each brain on each core: medians over the blocks, and ratios to `noop` in the same round."""
    for where, name in dict.fromkeys((one["core"], one["brain"]) for one in blocks):
        own, quiet = (
            [one for one in blocks if (one["core"], one["brain"]) == (where, brain)] for brain in (name, NOOP)
        )
        middle, beside = ({key: statistics.median(one[key] for one in some) for key in KEYS} for some in (own, quiet))
        missed, missed_beside, stops, stops_beside = (
            sum(one[key] for one in some) for key in ("missed", "stops") for some in (own, quiet)
        )
        what = f"UR5 at 500 Hz beside {name} at {fps} Hz, cerebellum on {where}"
        times = ", ".join(f"{key} {middle[key]:.1f} us" for key in TIMES)
        inference = f"inference p50 {middle['inference_p50']:.2f} ms, p99 {middle['inference_p99']:.2f} ms"
        report.add(what, f"{times}; {inference}; {sum(one['ticks'] for one in own)} ticks")
        if name == NOOP:
            continue
        pairs = [[one["wake_p99"] for one in some] for some in (own, quiet)]
        over, goal = statistics.median(ratios(*pairs)), GOALS["wake_p99"]
        value = f"{over:.2f} x ({middle['wake_p99']:.0f} us)"
        heading = f"{what}: lateness of ticks p99, over that beside noop"
        report.add(heading, value, f"at most {goal:g} x", met=over <= goal)
        more = statistics.median(a["late_share"] - b["late_share"] for a, b in zip(own, quiet, strict=True))
        stopped = f"; stopped and run again {stops}, beside noop {stops_beside}" if stops else ""
        shares = f"{100 * middle['late_share']:.2f} %, beside noop {100 * beside['late_share']:.2f} %"
        value = f"{shares}; missed {missed}, beside noop {missed_beside}{stopped}"
        is_met, goal = more <= GOALS["late_share"] and stops <= stops_beside, GOALS["late_share"]
        report.add(f"{what}: ticks later than 0.1 ms", value, f"at most {100 * goal:.1f} % more", met=is_met)
        frames, goal = middle["frames_per_s"], GOALS["frames_per_s"]
        value = f"{frames:.2f}, beside noop {beside['frames_per_s']:.2f}; {middle['cpu_ms']:.1f} CPU ms each"
        report.add(f"{what}: frames/s", value, f"at least {100 * goal:.0f} % of {fps}", met=frames >= goal * fps)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 3 if a goal was missed, 2 if nothing was measured."""
    options = parse_options(
        __doc__,
        arguments,
        rounds=(6, "blocks for each brain and core"),
        seconds=(10.0, "length of a block [s]"),
        perception={"type": Path, "help": "checkpoint of a bhd_perception, for 320 x 240 px"},
        pixels={"type": Path, "help": "checkpoint of a bhd_pixels, for this robot"},
    )
    check_lengths("rounds", options.rounds, options.seconds)
    torch.set_num_threads(1)
    # The untrained policy has no dataset to name, and is warned of in every block.
    logging.getLogger("bhd_lerobot.policies.learned").setLevel(logging.ERROR)
    busy = busy_share()
    try:
        with tempfile.TemporaryDirectory(prefix="bhd-bench-") as folder:
            image, state = first_look()
            checkpoints = {
                PERCEPTION: options.perception or untrained_perception(Path(folder) / "perception", image),
                PIXELS: options.pixels or untrained_pixels(Path(folder) / "pixels", state),
            }
            blocks = measure(options.rounds, options.seconds, checkpoints)
    except (BhdError, NotMeasuredError) as error:
        print(f"Nothing was measured: {error}", file=sys.stderr)
        return 2
    report = Report("A UR5 at 500 Hz, brains at 25 Hz")
    summarise_blocks(report, blocks)
    objects = statistics.mean(one["objects"] for one in blocks if one["brain"] == PERCEPTION)
    report.add("objects found per image", f"{objects:.1f}")
    add_conditions(report, busy, {f"refused was {one}": None for found in blocks for one in found["refused"]})
    report.numbers |= {"seconds": options.seconds, "busy": busy, "goals": GOALS, "blocks": blocks}
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
