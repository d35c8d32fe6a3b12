"""The arm of `network_arm.py` as a robot type, for our commands and for LeRobot's."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import bhd_lerobot as bhd


@dataclass(kw_only=True)
class NetworkArmConfig(bhd.UR5Config):
    """Options of the robot type ``network_arm``: those of a UR5, and where it is.

    Attributes:
        address: where the arm is, ``"host:port"``.
    """

    not_recorded: ClassVar[tuple[str, ...]] = ("address",)

    clock: str = "realtime"
    control_hz: int = 125
    physics_hz: int = 125
    plant: str = "network_arm:NetworkPlant"
    address: str = "127.0.0.1:47654"
    realtime: bhd.RealtimeConfig = field(default_factory=lambda: bhd.RealtimeConfig(plant_timeout_s=0.1))

    def body(self) -> bhd.Body:
        """Return a UR5's geometry and limits, with the latency that was measured of this arm."""
        body = super().body()
        return replace(body, arm=replace(body.need(bhd.Arm), latency_s=0.010))


@bhd.register_robot
class NetworkArm(bhd.UR5):
    """The arm on the network."""

    config_class = NetworkArmConfig
    name = "network_arm"
