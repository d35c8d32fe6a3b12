"""LeRobot's SO-101 arm on a serial bus that is a dictionary; everything above the packets is LeRobot's own."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lerobot.motors import MotorCalibration
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.motors.motors_bus import SerialMotorsBus, get_address
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig, so_follower

GOAL, PRESENT = "Goal_Position", "Present_Position"
LOW, HIGH = 1000, 3000
START = {1: 1100, 2: 1500, 3: 2000, 4: 2500, 5: 2900, 6: 1234}  # encoder steps, by the motor's id


class FakePort:
    is_open = False
    is_using = False

    def openPort(self) -> bool:  # noqa: N802  the SDK's name
        self.is_open = True
        return True

    def closePort(self) -> None:  # noqa: N802
        self.is_open = False

    def clearPort(self) -> None:  # noqa: N802
        pass

    def setPacketTimeoutMillis(self, timeout: int) -> None:  # noqa: N802
        pass


class FakeFeetechBus(FeetechMotorsBus):
    """The registers of the motors, and what was asked of them.

    Attributes:
        goals: the encoder steps of each goal that went over the wire, by the motor's id.
        asked: the values of each goal in the user's units, before LeRobot turned them into steps.
    """

    goals: list[dict[int, int]]
    asked: list[float]
    made: list["FakeFeetechBus"]

    def __init__(self, port: str, motors: Any, calibration: Any = None) -> None:
        SerialMotorsBus.__init__(self, port, motors, calibration)
        self.protocol_version = 0
        self.port_handler = FakePort()  # type: ignore[assignment]
        self.packet_handler = SimpleNamespace()  # type: ignore[assignment]
        self.goals, self.asked = [], []
        self.registers: dict[tuple[int, int], int] = {}
        for name, first in (("Min_Position_Limit", LOW), ("Max_Position_Limit", HIGH), (PRESENT, 0)):
            for motor in self.motors.values():
                self.registers[self._address(name), motor.id] = START[motor.id] if name == PRESENT else first
        self.made.append(self)

    def _address(self, name: str) -> int:
        return get_address(self.model_ctrl_table, "sts3215", name)[0]

    def _handshake(self) -> None:
        pass

    def _read(self, address: int, length: int, motor_id: int, **options: Any) -> tuple[int, int, int]:
        return self.registers.get((address, motor_id), 0), 0, 0

    def _write(self, address: int, length: int, motor_id: int, value: int, **options: Any) -> tuple[int, int]:
        self.registers[address, motor_id] = value
        return 0, 0

    def _sync_read(self, address: int, length: int, motor_ids: list[int], **options: Any) -> tuple[dict[int, int], int]:
        return {motor_id: self.registers.get((address, motor_id), 0) for motor_id in motor_ids}, 0

    def _sync_write(self, address: int, length: int, ids_values: dict[int, int], *args: Any, **options: Any) -> int:
        if address == self._address(GOAL):
            self.goals.append(dict(ids_values))
        return 0

    def sync_write(self, data_name: str, values: Any, **options: Any) -> None:
        if data_name == GOAL:
            self.asked += values.values()
        super().sync_write(data_name, values, **options)


def so101(folder: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> tuple[Any, list[FakeFeetechBus]]:
    """Return what makes a calibrated arm, and the list of the buses of all arms that it made."""
    made: list[FakeFeetechBus] = []
    monkeypatch.setattr(FakeFeetechBus, "made", made, raising=False)
    monkeypatch.setattr(so_follower, "FeetechMotorsBus", FakeFeetechBus)

    def make() -> SO101Follower:
        arm = SO101Follower(SO101FollowerConfig(port="/dev/none", id="arm", calibration_dir=folder, **options))
        arm.calibration.update(
            {name: MotorCalibration(motor.id, 0, 0, LOW, HIGH) for name, motor in arm.bus.motors.items()}
        )
        arm.bus.calibration = arm.calibration
        return arm

    return make, made
