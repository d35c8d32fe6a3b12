"""An arm of Universal Robots behind `ur_robot_driver`, below the cerebellum."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.ros2.live.network import LATCHED, SENSOR_DATA, Qos
from bhd_lerobot.ros2.live.spec import InputSpec, OutputSpec
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.views import JOINT_STATE
from bhd_lerobot.ros2.robots.plant import Ros2Plant

_SILENCE_S = 0.2  # of joints at 125 Hz
_FOREVER = float("inf")


@dataclass(frozen=True)
class JointReader:
    """Angles [rad] and speeds [rad/s] of joints, which are found by name."""

    joints: tuple[str, ...]

    @property
    def width(self) -> int:
        """Twice the number of joints."""
        return 2 * len(self.joints)

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the angles and then the speeds, shape (width,)."""
        names = list(message.name)
        if missing := [joint for joint in self.joints if joint not in names]:
            raise DatasetError(f"it has no {', '.join(missing)}; it has {', '.join(names) or 'no joint'}")
        for what, values in (("positions", message.position), ("velocities", message.velocity)):
            if len(values) != len(names):
                raise DatasetError(
                    f"it has {len(values)} {what} of {len(names)} joints; both are needed of every joint"
                )
        order = [names.index(joint) for joint in self.joints]
        return np.concatenate([message.position[order], message.velocity[order]])


@dataclass(frozen=True)
class NumberReader:
    """The one number of a message."""

    field: str
    width: int = 1

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the number, shape (1,)."""
        return np.array([getattr(message, self.field)], np.float64)


@dataclass(frozen=True)
class FloatsWriter:
    """Numbers as a Float64MultiArray."""

    width: int

    def encode(self, features: NDArray[np.float64], stamp_ns: int) -> bytes:
        """Return the message; it has no stamp."""
        return encode(ur.FLOATS, {"data": features[None]}, 1)[0]


class ArmPlant(Ros2Plant):
    """An arm whose active controller is `forward_position_controller`.

    In come ``/joint_states``, the speed scaling and the safety mode, out go positions, and the opening of a gripper.
    The driver knows no gripper: its opening reads as it was commanded last. Without commands the arm holds where it was
    commanded to be. Efforts are not read: the driver has the motors' currents [A].

    Args:
        config: the robot's configuration.
        body: its hardware.
    """

    command_hz = 125.0
    usual_latency_s = 0.1
    moves = 0.05  # [rad] of a joint

    def __init__(self, config: Any, body: Arm) -> None:
        if config.ros2.scan_yaw is not None:
            raise ConfigError(f"robot.ros2.scan_yaw is {config.ros2.scan_yaw}; an arm has no scanner.")
        joints = tuple(f"{joint}_joint" for joint in body.chain.joints)
        self._count = len(joints)
        self._opening = body.home[-1]
        self._rest: NDArray[np.float64] | None = None  # the joints at the first command
        inputs = (
            InputSpec(
                "/joint_states", JOINT_STATE, JointReader(joints), SENSOR_DATA, max(_SILENCE_S, config.ros2.silent_s)
            ),
            InputSpec(ur.SCALING_TOPIC, ur.FLOAT, NumberReader("data"), SENSOR_DATA, _FOREVER),
            InputSpec(ur.SAFETY_TOPIC, ur.SAFETY_MODE, NumberReader("mode"), LATCHED, silence_s=_FOREVER),
        )
        outputs = (
            OutputSpec(ur.POSITION_TOPIC, ur.FLOATS, FloatsWriter(self._count), Qos(1)),
            OutputSpec(ur.GRIPPER_TOPIC, ur.FLOATS, FloatsWriter(1), Qos(1), is_required=False),
        )
        super().__init__(body.name, config, inputs, outputs)
        self.hint += " A controller that is not active takes none (ros2 control list_controllers)."

    def commanded(self, ctrl: NDArray[np.float64]) -> float:
        """Return how far the joint that is to turn most is to turn from the first command [rad]."""
        self._rest = ctrl[0, : self._count].copy() if self._rest is None else self._rest
        return float(np.abs(ctrl[0, : self._count] - self._rest).max())

    def moved(self, out: PlantReading) -> float:
        """Return how far the joint that has turned most has turned from there [rad]."""
        return 0.0 if self._rest is None else float(np.abs(out.position[0, : self._count] - self._rest).max())

    def read_parts(self, state: Any, out: PlantReading) -> None:
        """Write the joints and the driver's status into `out`."""
        joints, count = self.numbers(state, 0), self._count
        out.position[0, :count], out.velocity[0, :count] = joints[:count], joints[count:]
        out.position[0, count], out.velocity[0, count] = self._opening, 0.0
        [scaling], [mode] = self.numbers(state, 1), self.numbers(state, 2)
        out.safety[0] = ur.safety_status(mode, 100.0 if math.isnan(scaling) else scaling)
        if out.stamp_ns is not None:
            out.stamp_ns[0] = state["measured_ns"][0]

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Send positions [rad] and the opening [m]."""
        super().write(ctrl)
        self._opening = float(ctrl[0, self._count])

    def recover(self) -> bool:
        """Return that the arm may have moved: a person or the dashboard ends its stop."""
        return True
