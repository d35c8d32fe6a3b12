"""Feetech's SDK as LeRobot calls it, with a simulated SO-101 on the bus: everything above the packets is LeRobot's own.

The port is a JSON file: `servo`, gains and friction in place of the model's; `start`, the joints [rad]. While a file
`PORT.fault` exists the bus answers nothing. Each goal is appended to `PORT.log`, and `PORT.torque` holds whether the
motors are on.
"""

import json
import math
import time
from pathlib import Path
from typing import Any

import mujoco

COMM_SUCCESS, COMM_RX_TIMEOUT = 0, -6
MAX_ID, BROADCAST_ID = 252, 254
GOAL, PRESENT, TORQUE = 42, 56, 40
MODEL = {0: 3, 1: 10, 3: 777}  # registers: firmware, model number
STEPS = 4095 / (2 * math.pi)
XML = Path(__file__).resolve().parents[3] / "bhd_lerobot" / "bodies" / "so101.xml"


def SCS_LOWORD(value: int) -> int:  # noqa: N802
    return value & 0xFFFF


def SCS_HIWORD(value: int) -> int:  # noqa: N802
    return value >> 16


def SCS_LOBYTE(value: int) -> int:  # noqa: N802
    return value & 0xFF


def SCS_HIBYTE(value: int) -> int:  # noqa: N802
    return (value >> 8) & 0xFF


class Arm:
    """The arm and its registers; it moves on with the wall clock."""

    def __init__(self, port: str) -> None:
        self.port, about = port, json.loads(Path(port).read_text())
        self.model = mujoco.MjModel.from_xml_path(str(XML))
        self.data = mujoco.MjData(self.model)
        model, servo = self.model, about.get("servo", {})
        self.gain = servo.get("stiffness", float(model.actuator_gainprm[0, 0]))
        model.dof_damping[:] = servo.get("damping", model.dof_damping[0])
        model.dof_frictionloss[:] = servo.get("friction", model.dof_frictionloss[0])
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        self.data.qpos[:] = about["start"]
        self.data.ctrl[:] = self.data.qpos
        self.registers: dict[tuple[int, int], int] = {}
        for k, (low, high) in enumerate(model.jnt_range.tolist()):
            ends = (2048 + round(low * STEPS), 2048 + round(high * STEPS))
            self.registers[k + 1, 9], self.registers[k + 1, 11] = ends if k != 4 else (0, 4095)  # it turns right round
            self.registers[k + 1, TORQUE] = 0
        self.since = time.monotonic()

    def run(self) -> None:
        model, now = self.model, time.monotonic()
        for k in range(6):
            gain = self.gain if self.registers[k + 1, TORQUE] else 0.0
            model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 1] = gain, -gain
        while self.since < now:
            mujoco.mj_step(model, self.data)
            self.since += model.opt.timestep

    def read(self, motor: int, address: int) -> int:
        if address == PRESENT:
            return 2048 + round(float(self.data.qpos[motor - 1]) * STEPS)
        return MODEL.get(address, self.registers.get((motor, address), 0))

    def write(self, motor: int, address: int, value: int) -> None:
        self.registers[motor, address] = value
        if address == TORQUE:
            Path(f"{self.port}.torque").write_text(str(value))
        if address == GOAL:
            value = min(max(value, self.registers[motor, 9]), self.registers[motor, 11])
            self.data.ctrl[motor - 1] = (value - 2048) / STEPS

    @property
    def is_silent(self) -> bool:
        return Path(f"{self.port}.fault").exists()


class PortHandler:
    is_open = is_using = False

    def __init__(self, port: str) -> None:
        self.port = port

    def openPort(self) -> bool:  # noqa: N802
        self.arm, self.is_open = Arm(self.port), True
        return True

    def closePort(self) -> None:  # noqa: N802
        self.is_open = False

    def clearPort(self) -> None:  # noqa: N802
        pass

    def setPacketTimeoutMillis(self, timeout: int) -> None:  # noqa: N802
        pass


class PacketHandler:
    def __init__(self, protocol: int) -> None:
        pass

    def getTxRxResult(self, result: int) -> str:  # noqa: N802
        return "[TxRxResult] There is no status packet!"

    def ping(self, port: PortHandler, motor: int) -> tuple[int, int, int]:
        return (*self.read2ByteTxRx(port, motor, 3)[:2], 0)

    def read2ByteTxRx(self, port: PortHandler, motor: int, address: int) -> tuple[int, int, int]:  # noqa: N802
        port.arm.run()
        return port.arm.read(motor, address), COMM_RX_TIMEOUT if port.arm.is_silent else COMM_SUCCESS, 0

    read1ByteTxRx = read4ByteTxRx = read2ByteTxRx  # noqa: N815

    def writeTxRx(  # noqa: N802
        self, port: PortHandler, motor: int, address: int, length: int, data: list[int]
    ) -> tuple[int, int]:
        port.arm.run()
        port.arm.write(motor, address, sum(byte << (8 * k) for k, byte in enumerate(data)))
        return COMM_RX_TIMEOUT if port.arm.is_silent else COMM_SUCCESS, 0


class GroupSyncRead:
    def __init__(self, port: PortHandler, packets: PacketHandler, address: int, length: int) -> None:
        self.port, self.start_address, self.data_length = port, address, length

    def clearParam(self) -> None:  # noqa: N802
        pass

    def addParam(self, motor: int) -> None:  # noqa: N802
        pass

    def txRxPacket(self) -> int:  # noqa: N802
        time.sleep(0.002)  # of the wire
        self.port.arm.run()
        return COMM_RX_TIMEOUT if self.port.arm.is_silent else COMM_SUCCESS

    def getData(self, motor: int, address: int, length: int) -> int:  # noqa: N802
        return self.port.arm.read(motor, address)


class GroupSyncWrite:
    def __init__(self, port: PortHandler, packets: PacketHandler, address: int, length: int) -> None:
        self.port, self.start_address, self.data_length = port, address, length
        self.values: dict[int, Any] = {}

    def clearParam(self) -> None:  # noqa: N802
        self.values = {}

    def addParam(self, motor: int, data: list[int]) -> None:  # noqa: N802
        self.values[motor] = sum(byte << (8 * k) for k, byte in enumerate(data))

    def txPacket(self) -> int:  # noqa: N802
        arm = self.port.arm
        arm.run()
        for motor, value in self.values.items():
            arm.write(motor, self.start_address, value)
        if self.start_address == GOAL:
            with Path(f"{arm.port}.log").open("a") as log:
                log.write(json.dumps(self.values) + "\n")
        return COMM_SUCCESS
