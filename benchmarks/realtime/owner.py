"""The brain's process of a robot that is measured: it owns the robot, and does what lines on its standard input say.

As a program, `python -m benchmarks.realtime.owner SPECIFICATION PARENT`, where the specification is JSON of an
`OwnerSpec` and PARENT the process that it dies with. Lines: ``run SECONDS``, ``pause``, ``end``. It answers with lines
of JSON: ``ready``, ``started``, ``done``, ``failed``. All else is read from the robot's shared memory, by others.
"""

import contextlib
import ctypes
import json
import os
import select
import signal
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.realtime.stage import SEED, pick_scene
from bhd_lerobot.control.messages import Mode, Reason

_PR_SET_PDEATHSIG = 1
_LOOK_S = 0.002  # between two looks of a brain that sends setpoints
AHEAD_S = 1.5  # how far a brain that sends chunks is ahead

# What a brain that sends setpoints moves with [rad/s; m/s], and how far from where it began [rad].
_ARM_SPEED = np.array([0.1, 0.0, 0.0, 0.0, 0.15, 0.15, 0.0])
_ARM_RANGE = 0.15
_BASE_SPEED = np.array([0.1, 0.3])
_BASE_TURN_S = 1.0


@dataclass(frozen=True)
class OwnerSpec:
    """What an owner is to run.

    Attributes:
        name: name of the robot.
        robot: ``"ur5"`` or ``"turtlebot3"``.
        config: options of the robot.
        realtime: options of its ``realtime``.
        drive: ``"episode"``: episodes that are recorded, driven by a brain; ``"setpoints"``: setpoints, one a frame,
            and after an emergency stop a reset and an activation; ``"chunks"``: setpoints, some time ahead.
        network: run a network of torch on the images of every frame; for episodes.
        folder: where it may write.
    """

    name: str
    robot: Literal["ur5", "turtlebot3"]
    config: dict[str, Any] = field(default_factory=dict)
    realtime: dict[str, Any] = field(default_factory=dict)
    drive: Literal["episode", "setpoints", "chunks"] = "setpoints"
    network: bool = False
    folder: str = ""

    def robot_config(self) -> Any:
        """Return the robot's configuration, on the wall clock."""
        from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
        from bhd_lerobot.robots.config_ur5 import UR5Config
        from bhd_lerobot.robots.host.config import RealtimeConfig

        kind: Any = {"ur5": UR5Config, "turtlebot3": TurtleBot3Config}[self.robot]
        return kind(id=self.name, clock="realtime", realtime=RealtimeConfig(**self.realtime), **self.config)


def scene_of(config: Any) -> Any:
    """Return the scene that a robot of the benchmark is in."""
    from bhd_lerobot.bodies.arenas import make_arena

    return make_arena("empty", SEED) if config.type == "turtlebot3" else pick_scene(config.fps)


def say(event: str, **values: Any) -> None:
    """Write a line; nobody may be listening any more."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps({"event": event, **values}), flush=True)


class Lines:
    """The lines of a descriptor, without waiting longer than asked."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._rest, self._ended = descriptor, b"", False

    def next(self, seconds: float | None) -> str | None:
        """Return the next line, ``"end"`` at the end of the file, or None if none comes in time."""
        while b"\n" not in self._rest:
            if self._ended:
                return "end"
            if not select.select([self._descriptor], [], [], seconds)[0]:
                return None
            got = os.read(self._descriptor, 4096)
            self._ended = not got
            self._rest += got
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode()


class Sway:
    """What a brain that sends setpoints asks for: steadily on, and back again."""

    def __init__(self, robot: str, fps: int) -> None:
        self._base, self._fps = robot == "turtlebot3", fps
        self._sign = 1.0
        self._since = 0.0
        self._centre: NDArray[np.float64] | None = None

    def next(self, command: NDArray[np.float64], now_s: float) -> NDArray[np.float64]:
        """Return the next setpoint, given the reference, both of shape (1, width)."""
        if self._base:
            if now_s - self._since > _BASE_TURN_S:
                self._sign, self._since = -self._sign, now_s
            return np.asarray((self._sign * _BASE_SPEED)[None])
        if self._centre is None:
            self._centre = command.copy()
        way = (command - self._centre)[0] @ np.sign(_ARM_SPEED) / np.count_nonzero(_ARM_SPEED)
        if abs(way) > _ARM_RANGE:
            self._sign = -np.sign(way)
        return np.asarray(command + self._sign * _ARM_SPEED / self._fps)

    def planned(self, start: NDArray[np.float64], at_s: float) -> NDArray[np.float64]:
        """Return the setpoint for a time, for a brain that sends them ahead; it moves all the time."""
        if self._base:
            return np.asarray((np.cos(at_s) * _BASE_SPEED)[None])
        return np.asarray(start + np.sin(at_s) * _ARM_SPEED)


def drive_setpoints(simulation: Any, spec: OwnerSpec, seconds: float, lines: Lines) -> bool:
    """Send setpoints at the frame rate for some seconds, or until a line comes; return whether that was ``end``."""
    bridge, fps = simulation.live_bridge, simulation.rates.fps
    sway = Sway(spec.robot, fps)
    start = time.monotonic()
    chunks = spec.drive == "chunks"
    every = 1.0 / min(fps, 25)
    first = bridge.latest["command"].copy()
    following = 0.0  # when the next setpoint is to be sent, or is due
    while (now := time.monotonic() - start) < seconds:
        mode = bridge.latest["mode"][0]
        if mode in (Mode.ESTOP, Mode.FAULT):
            if bridge.reset().reasons[0] == Reason.ACCEPTED:
                bridge.activate()
                following = time.monotonic() - start
        elif chunks:
            following = max(following, now)
            while following < now + AHEAD_S:
                due = bridge.now_ns + round((following - (time.monotonic() - start)) * 1e9)
                bridge.send(sway.planned(first, following), due_ns=due)
                following += every
        elif now >= following:
            bridge.send(sway.next(bridge.latest["command"], now))
            following = max(following + every, now)
        line = lines.next(_LOOK_S)
        if line is not None:
            return line == "end"
    return False


class Episodes:
    """Records episodes of a fixed length.

    Args:
        simulation: the robot.
        spec: what to run.
    """

    def __init__(self, simulation: Any, spec: OwnerSpec) -> None:
        from benchmarks.realtime.owner_brain import SwayBrain
        from bhd_lerobot.datasets.format.features import dataset_features
        from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

        self._simulation, self._brain = simulation, SwayBrain(with_network=spec.network)
        if simulation.camera_names:
            simulation.start_rendering()
        shape = (simulation.config.camera_height, simulation.config.camera_width, 3)
        physics = [f"physics_{k}" for k in range(simulation.physics_state.shape[1])]
        task = self._task(1.0)
        features = dataset_features(
            simulation.observation_names,
            simulation.action_names,
            dict.fromkeys(simulation.camera_names, shape),
            physics,
            task.environment_names,
        )
        self._recorder = DatasetRecorder.create(
            "bhd/benchmark",
            simulation.rates.fps,
            features,
            robot_type=spec.robot,
            root=Path(spec.folder) / f"{spec.name}-dataset",
        )

    def _task(self, seconds: float) -> Any:
        from bhd_lerobot.tasks.pick import PickConfig, PickTask

        return PickTask(PickConfig(duration_s=seconds), 1, self._simulation.rates.fps)

    def run(self, seconds: float) -> dict[str, Any]:
        """Record one episode; return what is to be said of it."""
        from bhd_lerobot.datasets.format import features as keys
        from bhd_lerobot.rollout.episode import EpisodeLoop
        from bhd_lerobot.rollout.provenance import episode_metadata
        from bhd_lerobot.rollout.types import EpisodeSpec

        task, recorder = self._task(seconds), self._recorder
        loop = EpisodeLoop(self._simulation, task, self._brain)
        before = recorder.num_frames
        with contextlib.closing(loop.run([EpisodeSpec(0, SEED)], open_images=recorder.begin_episode)) as episodes:
            episode = next(episodes)
        writer = episode.writer or recorder.begin_episode()
        metadata = episode_metadata(episode, split="train", task=task.parameters(), brain=self._brain.parameters())
        writer.set_columns(episode.columns)
        recorder.save(writer, task=episode.instruction, metadata=metadata)
        timing = episode.timing
        return {
            "event_of_task": episode.outcome.event.cause,
            "frames": recorder.num_frames - before,
            "drops": timing.drops,
            # By the clock: the last frame began when its observation was taken.
            "frames_due": round(float(episode.columns[keys.TIME][-1]) * self._simulation.rates.fps) + 1,
            "late_frames": timing.late_frames,
            "inference_p50_ms": timing.inference_p50 * 1e3,
            "inference_p99_ms": timing.inference_p99 * 1e3,
            "parameters": self._brain.parameter_count,
            "films": len(self._simulation.camera_names),
        }


def work(spec: OwnerSpec, lines: Lines) -> None:
    """Start the robot, and do what the lines say until they end."""
    from bhd_lerobot.rollout.registry import make_robot

    config = spec.robot_config()
    with contextlib.closing(make_robot(config)) as simulation:
        link = simulation.link  # type: ignore[attr-defined]
        scene, one = scene_of(config), np.zeros(1, np.intp)
        episodes: Episodes | None = None
        if spec.drive == "episode":
            episodes = Episodes(simulation, spec)
        say(
            "ready",
            block=link.block.name,
            pids=link.pids,
            refused=[f"{g['name']}: {g['detail']}" for g in link.grants if not g["granted"]],
            heavy=link.about["heavy"],
            command_timeout_s=simulation.body.limits.command_timeout_s,
        )
        while (line := lines.next(None)) != "end":
            word, _, argument = (line or "").partition(" ")
            if word != "run":
                continue
            said: dict[str, Any] = {}
            ended = False
            if episodes is not None:
                say("started")
                said = episodes.run(float(argument))
            else:
                simulation.reset(one, [scene], [SEED])
                simulation.begin()  # type: ignore[attr-defined]
                activate(simulation)
                say("started")
                ended = drive_setpoints(simulation, spec, float(argument), lines)
                simulation.stop(one)
            say("done", **said)
            if ended:
                return


def activate(simulation: Any) -> None:
    """Make sure that a robot takes commands."""
    if simulation.live_bridge.latest["mode"][0] == Mode.INACTIVE:
        simulation.live_bridge.activate()


def main(specification: str, parent: int) -> int:
    """Run an owner; return its exit status."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before it could have told the kernel to kill this process
        return 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the benchmark decides when it is over
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        work(OwnerSpec(**json.loads(specification)), Lines(0))
    except Exception as error:
        say("failed", message=f"{type(error).__name__}: {error}")
        return 1
    return 0


def as_argument(spec: OwnerSpec) -> str:
    """Return a specification as a program's argument."""
    return json.dumps(asdict(spec))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
