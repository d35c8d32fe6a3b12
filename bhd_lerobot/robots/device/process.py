"""The process that calls a LeRobot robot: reads as fast as its bus answers, and sends the newest command after each.

Started by `DevicePlant` as ``python -m bhd_lerobot.robots.device.process``. Its calls block for as long as the bus
takes; the cerebellum goes on meanwhile, and stops the arm if what is read becomes too old.
"""

import contextlib
import math
import os
import pickle
import signal
import sys
import time
from collections import deque
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import BhdError, ConfigError, RealtimeError, as_text
from bhd_lerobot.options.parse import types_of
from bhd_lerobot.robots.device.plant import Channel, DeviceJob, Word
from bhd_lerobot.robots.device.units import Motor
from bhd_lerobot.robots.external.device import Device
from bhd_lerobot.robots.external.lock import RobotLock

_SLOPE_S = 0.08  # of readings, whose slope is the speed
_MOST_FAILURES = 3  # calls in a row that may fail: on a bus a packet is lost


class Speed:
    """Speeds from positions: the slope of the line through the readings of the last 0.08 s, by least squares."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, NDArray[np.float64]]] = deque()

    def add(self, stamp_ns: int, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take a reading; return the speeds, 0 until there are three readings."""
        kept, now = self._kept, stamp_ns / 1e9
        kept.append((now, position))
        while now - kept[0][0] > _SLOPE_S:
            kept.popleft()
        if len(kept) < 3:
            return np.zeros(len(position))
        times = np.array([time for time, _ in kept])
        times -= times.mean()
        slope: NDArray[np.float64] = times @ np.array([one for _, one in kept]) / max(float(times @ times), 1e-12)
        return slope


def motors_of(robot: Any) -> dict[str, Motor]:
    """Return what a robot's bus says of its features, by name."""
    bus, calibration, found = getattr(robot, "bus", None), getattr(robot, "calibration", None) or {}, {}
    for name, motor in (getattr(bus, "motors", None) or {}).items():
        resolution, half = (getattr(bus, "model_resolution_table", None) or {}).get(getattr(motor, "model", "")), None
        if name in calibration and resolution:
            steps = calibration[name].range_max - calibration[name].range_min
            half = steps / (resolution - 1) * math.pi
        found[f"{name}.pos"] = Motor(str(getattr(getattr(motor, "norm_mode", None), "name", "")), half)
    return found


class DeviceProcess:
    """The process's side.

    Args:
        job: what to run.
        channel: what it shares with the plant.
        pipe: to the plant's process; its end means that nobody commands any more.
    """

    def __init__(self, job: DeviceJob, channel: Channel, pipe: Connection) -> None:
        from bhd_lerobot.stock import make_robot_from_config

        self._channel, self._pipe, self._period = channel, pipe, 1.0 / job.hz
        config = pickle.loads(job.device)
        self._shown = " ".join(filter(None, (types_of(config), config.id and repr(config.id))))
        try:
            self._robot = make_robot_from_config(config)
        except Exception as error:  # of another package's code
            raise ConfigError(f"{self._shown} cannot be made: {as_text(error.__cause__ or error)}") from error
        self._device = Device(self._robot)
        if self._device.camera_shapes:
            raise ConfigError(f"{self._shown} has cameras, which are not observed below a body: leave them out")
        self._lock = RobotLock(config)
        self._state, self._speed = np.zeros((), channel.reading), Speed()

    def connect(self) -> None:
        """Agree with the plant on the numbers, and connect the robot."""
        device, robot = self._device, self._robot
        both = [name for name in device.action_names if name in device.observation_names]
        self._pipe.send(("made", (self._shown, motors_of(robot), both)))
        names = self._pipe.recv()
        self._places = [device.observation_names.index(name) for name in names]
        self._sent = [device.action_names.index(name) for name in names]
        try:
            robot.connect(calibrate=False)
            if is_calibrated := robot.is_calibrated:
                self._found = self._read()
        except Exception as error:  # of another package's code
            raise RealtimeError(
                f"{self._shown} cannot be connected: {as_text(error)}. Check its power, its cable and its port, and "
                "that no other program uses it"
            ) from error
        if not is_calibrated:
            raise RealtimeError(
                f"{self._shown} is not calibrated, or its motors hold another calibration than its file: run "
                "lerobot-calibrate with the options of robot.device, as --robot.type, --robot.port and --robot.id"
            )
        self._pipe.send(("ready", None))

    def _read(self) -> NDArray[np.float64]:
        """Read and publish once; return what the device measures of its actions."""
        reading, state = self._device.observe(), self._state
        state["stamp_ns"], state["position"], state["problem"] = reading.state_ns, reading.state[self._places], b""
        state["velocity"] = self._speed.add(reading.state_ns, reading.state[self._places])
        self._channel.readings.publish(state)
        return self._device.measured(reading.state)

    def run(self) -> None:
        """Read and send until the plant says end, or is gone."""
        channel, failures, sent = self._channel, 0, 0
        action = np.nan_to_num(self._found)  # what is no joint of the body stays where it is, and has no speed
        while not channel.words[Word.END]:
            due = time.monotonic() + self._period
            if self._pipe.poll():  # it has closed its end: whoever commands is gone
                channel.words[Word.KEEP] = 1
                return
            try:
                self._read()
                if (number := len(channel.commands)) > sent and (command := channel.commands.latest()) is not None:
                    action[self._sent] = command["position"]
                    self._device.send(action)
                    sent = number
                failures = 0
            except Exception as error:  # of another package's code
                failures += 1
                if failures >= _MOST_FAILURES:
                    self._state["problem"] = as_text(error).encode()[:400]
                    channel.readings.publish(self._state)
            time.sleep(max(0.0, due - time.monotonic()))

    def close(self) -> None:
        """Disconnect the robot. After a stop its motors stay on."""
        try:
            if self._robot.is_connected:
                if self._channel.words[Word.KEEP] and self._device.keep_torque():
                    print(
                        f"{self._shown} was stopped: its motors stay on, so that nothing falls. Hold it before its "
                        "power is switched off, or before it is connected again.",
                        file=sys.stderr,
                    )
                self._robot.disconnect()
        except Exception as error:  # of another package's code
            print(f"warning: {self._shown} could not be disconnected: {as_text(error)}", file=sys.stderr)
        self._lock.close()


def main() -> int:
    """Run the process; its arguments are the descriptors of its pipe and of the memory."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe = Connection(int(sys.argv[1]))
    job: DeviceJob = pipe.recv()
    channel = Channel(job.width, int(sys.argv[2]))
    try:
        process = DeviceProcess(job, channel, pipe)
        try:
            process.connect()
            process.run()
        finally:
            process.close()
    except (BhdError, EOFError) as error:
        with contextlib.suppress(OSError):
            pipe.send(("failed", str(error)))
        return 2
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # a driver's thread that hangs holds nothing up
