"""Another package's LeRobot robot, with the interface of `Robots`."""

import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.commands import Chunk, Command
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Reason, SendResult
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, RealtimeError, as_text
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.device import Device
from bhd_lerobot.robots.external.frames import DeviceFrame, FrameThread
from bhd_lerobot.robots.external.gate import Gate
from bhd_lerobot.robots.external.lock import RobotLock
from bhd_lerobot.robots.host.robots import Deliver, Frame, FrameReport


class FrameClock:
    """How punctual the frames of a robot are; see `Clock`."""

    grants = None

    def __init__(self, frames: FrameThread, device: Device) -> None:
        self._frames, self._device = frames, device

    @property
    def sensor_period_s(self) -> float:
        """Time between two readings of the slowest sensor [s]; 0 if it is not known."""
        return self._device.sensor_period_s

    def statistics(self) -> TimingStatistics:
        """Return how punctual the frames of the present episode are; live."""
        return self._frames.statistics


class LeRobotHost:
    """One robot of another package on the wall clock; see `Robots`.

    There is no cerebellum: what the robot does with an action between two frames, how hard it accelerates and how it
    stops is its own.

    Args:
        robot: a LeRobot robot, connected.
        fps: frames a second [Hz].
        config: what is let through to it.
        lock: let go of when it is closed.
        robot_config: the configuration that the robot was made of; its attribute `config` if None, which not all have.
    """

    n = 1
    body = None
    world = None
    knows: frozenset[str] = frozenset()

    def __init__(
        self, robot: Any, fps: int, config: GateConfig, lock: RobotLock | None = None, robot_config: Any = None
    ) -> None:
        self._lock, self.robot = lock, robot
        self.config = robot.config if robot_config is None else robot_config
        self.device = Device(robot)
        self.rates = Rates(fps, fps, fps)
        self.action_names, self.observation_names = self.device.action_names, self.device.observation_names
        self.camera_shapes = self.device.camera_shapes
        self.gate = Gate(self.action_names, config, self.device.known_ranges())
        self.running = np.ones(1, np.bool_)
        self._frames = FrameThread(self.device, self.gate, fps, config)
        self.clock = FrameClock(self._frames, self.device)
        self._seen: DeviceFrame | None = None  # the frame that the brain observes
        self._shown: DeviceFrame | None = None  # the frame whose images are given out
        self._chunk: tuple[int, NDArray[np.float64]] | None = None  # the frame of its first action, and its actions

    @property
    def columns(self) -> dict[str, tuple[str, ...]]:
        """What frames and reports hold beside observation and action."""
        ages = {keys.IMAGE_AGE: tuple(self.camera_shapes), keys.READING_AGE: self.device.reading_names}
        return {key: names for key, names in ages.items() if names}

    @property
    def notes(self) -> list[str]:
        """What stands in front of the robot, and what cannot be promised for it."""
        gate, count = self.gate, len(self.action_names)
        unlimited = gate.unlimited()
        changed = int(np.isfinite(gate.max_change).sum())
        unknown = f"; not known, so not limited: {', '.join(unlimited)} (--gate.range.NAME='[low, high]')"
        lines = [
            f"{self.device.name} is driven by its own interface, {self.rates.fps} actions a second. In front of it:",
            f"  range: {count - len(unlimited)} of {count} actions limited{unknown if unlimited else ''}",
            f"  change in a frame: {changed} of {count} actions limited{'' if changed else ' (--gate.max_change)'}",
            "  always: finite values, a time-out of the brain, an emergency stop that holds the robot",
            "  not promised: limits of acceleration and jerk, a braking distance, a stop during a call that blocks",
        ]
        return [escape(line) for line in lines]

    @property
    def problem(self) -> str:
        """Why the robot was last stopped by a fault, as text."""
        return self._frames.problem

    @property
    def estop_pressed(self) -> bool:
        """Whether the emergency stop is pressed; it latches until the program ends."""
        return self._frames.is_estopped

    def estop(self) -> None:
        """Press the emergency stop: the robot holds where it is."""
        self._frames.estop()

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode; its time begins with the first observation. A person has set up the scene."""
        self._seen = self._shown = None
        self._chunk = None
        self.running[:] = True
        return np.zeros((len(ids), 0))

    def stop(self, ids: NDArray[np.intp]) -> None:
        """End the episode: positions stay, speeds are set to 0, and the robot gets nothing more."""
        if len(ids):
            self.running[:] = False
            self._frames.pause()

    def observe(self) -> Frame:
        """Return the observation that the present frame began with; its age is what it is now.

        Raises:
            RealtimeError: the robot cannot be observed.
        """
        if self._seen is None:
            self._seen = self._frames.begin()
        self._shown = self._seen
        return self._frame_of(self._seen, time.monotonic_ns())

    def _frame_of(self, frame: DeviceFrame, now_ns: int) -> Frame:
        reading = frame.reading
        times = {keys.IMAGE_AGE: reading.image_ns, keys.READING_AGE: reading.reading_ns}
        columns = {
            key: np.array([[now_ns - times[key][name] for name in names]]) / NANOSECONDS
            for key, names in self.columns.items()
        }
        time_ns = np.array([reading.state_ns - self._frames.origin_ns])
        return Frame(reading.state[None], time_ns, np.array([now_ns - reading.oldest_ns]), columns)

    def step(self, command: Command) -> FrameReport:
        """Send an action, wait for the end of the frame that it is now, and report it.

        Raises:
            ConfigError: the brain gives goals.
        """
        seen = self._seen
        if seen is None:
            raise RealtimeError("The robot is in no episode. Call reset() and observe() first.")
        frames = self._frames.act(self._action_of(command, seen), seen)
        stopped = frames[-1].mode in (Mode.ESTOP, Mode.FAULT) or len(frames) == 1
        over = frames if stopped else frames[:-1]
        *missed, report = [
            self._report(frame, after) for frame, after in zip(over, [*frames[1:], frames[-1]], strict=False)
        ]
        report.missed = missed
        self._seen = frames[-1]
        return report

    def _action_of(self, command: Command, seen: DeviceFrame) -> NDArray[np.float64] | None:
        match command:
            case Chunk(actions):
                self._chunk = seen.number, actions[:, 0]
            case np.ndarray():
                self._chunk = None
                return command[0]
            case None:
                pass
            case _:
                kind = type(command).__name__
                raise ConfigError(f"A brain that gives {kind} cannot drive {self.device.name}, which takes actions.")
        if self._chunk is None:
            return None
        first, rows = self._chunk
        # The actions of frames that went by are left out: a brain that took its time does not make the robot hurry.
        row = min(self._frames.newest().number - first, len(rows) - 1)
        if row == len(rows) - 1:
            self._chunk = None  # it is over: from now on the robot waits for the brain
        action: NDArray[np.float64] = rows[row]
        return action

    def _report(self, frame: DeviceFrame, after: DeviceFrame) -> FrameReport:
        seen = frame.reading
        return FrameReport(
            applied=frame.applied[None],
            requested=frame.requested[None],
            sent=SendResult(np.array([Reason.ESTOP if frame.mode == Mode.ESTOP else Reason.ACCEPTED], np.int8)),
            limits=np.array([frame.limits]),
            watchdog=np.array([frame.watchdog]),
            mode=np.array([frame.mode], np.int8),
            truth=partial(self._truth_at, after),
            columns={
                keys.COMMAND_AGE: np.array([frame.command_age_ns / NANOSECONDS]),
                keys.LATENESS: np.array([max(0, frame.started_ns - frame.due_ns) / NANOSECONDS]),
                keys.OVERRUNS: np.array([int(frame.worked_ns > frame.due_ns + self._frames.period_ns)]),
                keys.SKIPPED: np.array([frame.skipped]),
            },
            number=frame.number,
            # A brain that did not observe it did not wait for it.
            seen=self._frame_of(frame, max([seen.state_ns, *seen.image_ns.values()])),
        )

    def _truth_at(self, after: DeviceFrame) -> None:
        """What is shown from now on is the frame after: its beginning is the end of this one."""
        self._shown = after

    def truth(self) -> None:
        """Nothing is known: a person judges."""
        return

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return no poses, shape (0, 7): it is not known what the observations mean."""
        return np.zeros((0, 7))

    # --- images ------------------------------------------------------------------------------------------------------

    def start_rendering(self) -> None:
        """There is nothing to prepare: the robot's cameras run."""

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> "Future[NDArray[np.uint8]]":
        """Return the image of a camera at the start of the frame that is shown."""
        if self._shown is None:
            raise RealtimeError("The robot is in no episode. Call reset() and observe() first.")
        image = self._shown.reading.images[camera]
        made: Future[NDArray[np.uint8]] = Future()
        if deliver is not None:
            deliver(image)
        made.set_result(image)
        return made

    def close(self) -> None:
        """Disconnect the robot. May be called twice; a call that does not return is not waited for.

        After an emergency stop its motors keep their torque, so that nothing falls or is let go of.
        """
        try:
            if self._frames.close() and self.robot.is_connected:
                if self.estop_pressed and self.device.keep_torque():
                    print(
                        f"{self.device.name} was stopped: its motors stay on, so that nothing falls. Hold it before "
                        "its power is switched off, or before it is connected again.",
                        file=sys.stderr,
                    )
                self.robot.disconnect()
        except Exception as error:  # of another package's code: what was recorded is reported all the same
            words = as_text(error)
            print(f"warning: {self.device.name} could not be disconnected: {words}", file=sys.stderr)
        if self._lock is not None:
            self._lock.close()
