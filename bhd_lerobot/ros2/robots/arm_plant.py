"""An arm of Universal Robots behind `ur_robot_driver`, below the cerebellum."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.ros2.live.network import LATCHED, SENSOR_DATA, WHEEL_SPEEDS, Qos
from bhd_lerobot.ros2.live.spec import InputSpec, OutputSpec
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.mapping import fields_of
from bhd_lerobot.ros2.messages.presets import columns
from bhd_lerobot.ros2.messages.table import JOINTS
from bhd_lerobot.ros2.robots.plant import Ros2Plant

_SILENCE_S = 0.2  # of joints at 125 Hz
_FOREVER = float("inf")


class ArmPlant(Ros2Plant):
    """An arm whose active controller is `forward_position_controller`.

    In come ``/joint_states``, the speed scaling and the safety mode, out go positions, and the opening of a gripper,
    if there is one. The driver knows none: its opening reads as it was commanded last. Without commands the arm holds
    where it was commanded to be. Efforts are not read: the driver has the motors' currents [A].
    """

    command_hz = 125.0
    usual_latency_s = 0.1
    moves = 0.05  # [rad] of a joint

    def __init__(self, config: Any, body: Body) -> None:
        if config.ros2.scan_yaw is not None:
            raise ConfigError(f"robot.ros2.scan_yaw is {config.ros2.scan_yaw}; an arm has no scanner.")
        if config.ros2.wheel_speeds != WHEEL_SPEEDS[0]:
            raise ConfigError(f"robot.ros2.wheel_speeds is {config.ros2.wheel_speeds!r}; an arm has no wheels.")
        arm = body.need(Arm)
        joints = arm.chain.joints
        self._count, self._has_gripper = len(joints), arm.gripper is not None
        self._opening = arm.home[-1]
        self._rest: NDArray[np.float64] | None = None  # the joints at the first command
        find_type(ur.SAFETY_MODE)
        states = columns("/joint_states", JOINTS, [f"{joint}.{end}" for end in ("pos", "vel") for joint in joints])
        silence_s = max(_SILENCE_S, config.ros2.silent_s)
        inputs = (
            InputSpec.of(states, SENSOR_DATA, silence_s),
            InputSpec.of(fields_of(ur.SCALING_TOPIC, ur.FLOAT, ["data"]), SENSOR_DATA, _FOREVER),
            InputSpec.of(fields_of(ur.SAFETY_TOPIC, ur.SAFETY_MODE, ["mode"]), LATCHED, _FOREVER),
        )
        positions = fields_of(ur.POSITION_TOPIC, ur.FLOATS, [f"data[{k}]" for k in range(self._count)])
        outputs = [OutputSpec.of(positions, Qos(1))]
        if self._has_gripper:
            opening = fields_of(ur.GRIPPER_TOPIC, ur.FLOATS, ["data[0]"])
            outputs.append(OutputSpec.of(opening, Qos(1), is_required=False))
        super().__init__(body.name, config, inputs, tuple(outputs))
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
        if self._has_gripper:
            out.position[0, count], out.velocity[0, count] = self._opening, 0.0
        [scaling], [mode] = self.numbers(state, 1), self.numbers(state, 2)
        out.safety[0] = ur.safety_status(mode, 100.0 if math.isnan(scaling) else scaling)
        if out.stamp_ns is not None:
            out.stamp_ns[0] = state["measured_ns"][0]

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Send positions [rad], and the opening [m]."""
        super().write(ctrl)
        if self._has_gripper:
            self._opening = float(ctrl[0, self._count])

    def recover(self) -> bool:
        """Return that the arm may have moved: a person or the dashboard ends its stop."""
        return True
