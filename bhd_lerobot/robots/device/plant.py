"""A LeRobot robot below the cerebellum. It is made in the real-time process, and imports neither LeRobot nor torch."""

import mmap
import os
import socket
import subprocess
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import ConfigError, PlantLostError, RealtimeError
from bhd_lerobot.programs import start_program
from bhd_lerobot.robots.device.units import Unit, unit_of

_START_S, _END_S = 90.0, 5.0  # that the device's process may take to import and connect, and to disconnect
_SLOTS, _TEXT = 4, 400
_LATENCY_S = 0.05  # of a serial bus with its servos
_MOST_SAG = 0.1  # [rad] that commands are raised by at the most, to carry the arm's weight


class Word(IntEnum):
    """Single numbers that both processes see."""

    END = 0
    """Whether the device's process is to end."""
    KEEP = 1
    """Whether the motors stay on at the end, whatever the device's options say: it was stopped."""


class Channel:
    """Readings one way and commands the other, in the units of the device; neither side waits for the other.

    Args:
        width: how many numbers.
        descriptor: of the memory; new memory if None.
    """

    def __init__(self, width: int, descriptor: int | None = None) -> None:
        numbers = ("position", np.float64, (width,)), ("velocity", np.float64, (width,))
        self.reading = np.dtype([("stamp_ns", np.int64), *numbers, ("problem", np.bytes_, _TEXT)])
        self.command = np.dtype([("position", np.float64, (width,))])
        first, second = (-(-StateRing.nbytes(dtype, _SLOTS) // 64) * 64 for dtype in (self.reading, self.command))
        if descriptor is None:
            descriptor = os.memfd_create("bhd-device")
            os.ftruncate(descriptor, 64 + first + second)
        self.descriptor = descriptor
        memory: Any = memoryview(mmap.mmap(descriptor, 64 + first + second))
        self.words = np.frombuffer(memory, np.int64, len(Word))
        self.readings = StateRing(self.reading, _SLOTS, memory[64:])
        self.commands = StateRing(self.command, _SLOTS, memory[64 + first :])


@dataclass(frozen=True)
class DeviceJob:
    """What the device's process is to run.

    Attributes:
        device: the configuration of the LeRobot robot, pickled.
        width: how many numbers are read and sent.
        hz: how often at the most [Hz].
    """

    device: bytes
    width: int
    hz: int


class DevicePlant(Plant):
    """An arm that LeRobot drives, by positions.

    Of a device positions are known and nothing else: speeds are the slopes of its last readings, efforts are not read,
    and the servos are taken to give way to the arm's weight, which commands make up for.

    Args:
        config: the robot's configuration, of which `device` is that of the LeRobot robot, pickled.
        body: its hardware, an arm.
    """

    n, latency_s = 1, _LATENCY_S

    def __init__(self, config: Any, body: Body) -> None:
        arm = body.need(Arm)
        self._arm, self._names = arm, [name.removesuffix(".pos") for name in arm.limits.names]
        self._dof, self._rows = len(arm.chain.joints), dict(config.units)
        if wrong := [name for name in self._rows if name not in self._names]:
            raise ConfigError(f"robot.units has {wrong[0]!r}, and the joints are {', '.join(self._names)}")
        self._job = DeviceJob(config.device, len(self._names), config.rates.control_hz)
        self._dynamics = ArmDynamics(body)
        self._still = np.zeros((1, self._dof))
        self._stiffness = np.asarray(arm.servo_stiffness[: self._dof])
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._enabled = False
        self.hint = "Commands go to the motors by LeRobot: check that they are powered, and that the arm is free."

    def open(self) -> None:
        """Start the device's process, check what the device is, and connect it.

        Raises:
            ConfigError: it is not the arm that the body describes.
            RealtimeError: it cannot be connected.
        """
        self._channel = Channel(self._job.width)
        ours, theirs = socket.socketpair()
        descriptors = theirs.fileno(), self._channel.descriptor
        with theirs:
            self._process = start_program("bhd_lerobot.robots.device.process", *descriptors, descriptors=descriptors)
        self._pipe = Connection(ours.detach())
        try:
            self._pipe.send(self._job)
            device, motors, features = self._answer()
            units = [unit_of(name, self._rows.get(name), motors, features, device) for name in self._names]
            self._check_home(units, device)
            self._scale, self._offset = (np.array([getattr(one, key) for one in units]) for key in ("scale", "offset"))
            self._pipe.send([one.feature for one in units])
            self._answer()
        except BaseException:
            self.close()
            raise

    def _answer(self) -> Any:
        assert self._pipe is not None
        if not self._pipe.poll(_START_S):
            raise RealtimeError(f"its process did not answer within {_START_S:g} s")
        try:
            kind, value = self._pipe.recv()
        except (EOFError, OSError):
            raise PlantLostError("its process ended while it started") from None
        if kind == "failed":
            raise RealtimeError(value)
        return value

    def _check_home(self, units: list[Unit], device: str) -> None:
        """Check that the arm can get home as it is calibrated."""
        for name, unit, home in zip(self._names, units, self._arm.home, strict=True):
            low, high = unit.range
            if not low - 1e-3 <= home <= high + 1e-3:
                raise ConfigError(
                    f"{name} of {device} is calibrated from {low:.3f} to {high:.3f}, and home is {home:.3f}, outside "
                    "of that. Calibrate it from the middle of all its ranges (lerobot-calibrate), or say what its "
                    f"readings mean with robot.units.{name}"
                )

    def enable(self) -> None:
        """Let commands through from now on."""
        self._enabled = True

    def _newest(self) -> Any:
        """Return the newest record of the device.

        Raises:
            PlantLostError: its process has ended.
            RealtimeError: it reads nothing any more.
        """
        status = None if self._process is None else self._process.poll()
        if status is not None:
            raise PlantLostError(f"The process of the device ended with status {status}")
        state: Any = self._channel.readings.latest()
        if state is None:
            raise RealtimeError("The device has read nothing yet")
        if problem := bytes(state["problem"]).decode(errors="ignore"):
            raise RealtimeError(problem)
        return state

    def read(self, out: PlantReading) -> None:
        """Write the newest readings into `out`."""
        state = self._newest()
        out.position[0] = state["position"] * self._scale + self._offset
        out.velocity[0] = state["velocity"] * self._scale
        if out.stamp_ns is not None:
            out.stamp_ns[0] = state["stamp_ns"]

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Send positions, raised by as much as the servos give way to the arm's weight, and the opening."""
        if not self._enabled:
            return
        sent, dof = ctrl[0].copy(), self._dof
        weight = self._dynamics.torque(ctrl[:, :dof], self._still, self._still)[0]
        sent[:dof] += np.clip(weight / self._stiffness, -_MOST_SAG, _MOST_SAG)
        record = np.zeros((), self._channel.command)
        record["position"] = (sent - self._offset) / self._scale
        self._channel.commands.publish(record)

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Keep the motors on at the end if the arm is stopped by then: what holds something must not fall."""
        self._channel.words[Word.KEEP] = mode[0] in (Mode.ESTOP, Mode.FAULT)

    def recover(self) -> bool:
        """Return that the arm may have moved by hand."""
        return True

    def close(self) -> None:
        """Disconnect; the servos keep the last position, or are switched off as the device's options say."""
        self._enabled = False
        if (process := self._process) is not None:
            self._channel.words[Word.END] = 1
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            os.close(self._channel.descriptor)
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None
