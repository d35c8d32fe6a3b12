"""Where other nodes are looked for, and how messages are kept for them."""

import os
import re
from dataclasses import dataclass, field
from typing import Annotated, Any

from bhd_lerobot.errors import ConfigError, install_extra
from bhd_lerobot.options.declared import Finite, NotNegative, OneOf, Options, Positive, Range

_MOST_LATENCY_S = 1.0  # [s] later than this nobody notices in time that a robot does not follow
_DOMAINS = 233  # the ports of further ones lie beyond 65535
_MOST_KEPT = 10_000
_ADDRESS = re.compile(r"[\w.:%-]+")
DISTROS = ("humble", "jazzy")
WHEEL_SPEEDS = ("m/s", "rad/s")
Domain = Annotated[int, Range(f"[0, {_DOMAINS - 1}]")]


@dataclass(frozen=True)
class NetworkConfig(Options):
    """The network of ROS 2 nodes.

    Attributes:
        domain: number of the ROS domain; by default that of the environment variable ROS_DOMAIN_ID, or 0.
        interface: network interface or address; by default the loopback interface, on which only nodes of this machine
            are found. ``auto`` takes the interface that Cyclone DDS prefers.
        peers: addresses of further machines, for networks without multicast.
        distro: whose interfaces are used where distributions differ: ``jazzy`` (and later) or ``humble``.
    """

    domain: Domain | None = None
    interface: str = "lo"
    peers: list[str] = field(default_factory=list)
    distro: Annotated[str, OneOf(DISTROS)] = "jazzy"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (self.interface, *self.peers):
            if not _ADDRESS.fullmatch(name):
                raise ConfigError(f"{name!r} is neither a network interface nor an address.")

    @property
    def domain_number(self) -> int:
        """The domain's number.

        Raises:
            ConfigError: ROS_DOMAIN_ID is none.
        """
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdecimal() or int(text) >= _DOMAINS:
            raise ConfigError(
                f"The environment variable ROS_DOMAIN_ID is {text!r}; it is a number from 0 to {_DOMAINS - 1}."
            )
        return int(text)

    @property
    def is_local(self) -> bool:
        """Whether only nodes of this machine are found."""
        return self.interface in ("lo", "127.0.0.1")

    def cyclonedds_xml(self) -> str:
        """Return the configuration of Cyclone DDS.

        Type information is ignored: with it nothing with a sequence or an array arrives from Fast DDS (11.0.1).
        """
        peers = (*(("127.0.0.1",) if self.is_local else ()), *self.peers)
        discovery = "".join(f'<Peer address="{peer}"/>' for peer in peers)
        by_address = self.interface[:1].isdigit()
        interface = f'<NetworkInterface {"address" if by_address else "name"}="{self.interface}"/>'
        if self.interface == "auto":
            interface = '<NetworkInterface autodetermine="true"/>'
        multicast = "false" if self.is_local else "true"
        return (
            '<CycloneDDS><Domain Id="any"><General>'
            f"<Interfaces>{interface}</Interfaces><AllowMulticast>{multicast}</AllowMulticast></General>"
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>99</MaxAutoParticipantIndex>"
            f"<Peers>{discovery}</Peers></Discovery>"
            "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
            "</Domain></CycloneDDS>"
        )


@dataclass(frozen=True)
class Ros2Config(NetworkConfig, prefix="robot.ros2."):
    """A robot on the network.

    Attributes:
        command_hz: how often new commands are sent at the most [Hz]: at once, if the last new one is old enough. One
            that stays is repeated half as often. 0: 50 Hz to a base, 125 Hz to an arm.
        timeout_s: without a sign of life of the brain's process for so long the robot brakes, without a command of the
            cerebellum it is stopped by its node [s].
        silence_s: a topic that sends nothing for so long is a fault [s]; by default 0.5, and 1 of scans. The robot type
            ``ros2`` has `robot.topic_timeout_s` for it.
        synchronised: the clocks of the robot and of this machine are synchronised (NTP, PTP), so that a reading's age
            is known from its stamp. Otherwise the smallest delay of the network counts as none.
        latency_s: time from a command until the robot's readings show it [s], with the network and the motors; a robot
            that follows so late is not blocked. By default 0.3 of a base, 0.1 of an arm.
        namespace: in front of the robot's topics, such as ``/tb3_1``.
        scan_frame: the frame of scans, where ``/tf_static`` does not state how the scanner is mounted.
        scan_yaw: where the scanner's zero points [rad], 0 is straight ahead; by default as ``/tf_static`` states.
        wheel_speeds: unit of a base's speeds in ``/joint_states``: ``m/s``, as the TurtleBot3's own node has them, or
            ``rad/s``, as ROS defines them, and Gazebo has them.
    """

    command_hz: NotNegative = 0.0
    timeout_s: Positive = 0.2
    silence_s: Positive | None = None
    synchronised: bool = False
    latency_s: Annotated[float, Range(f"[0, {_MOST_LATENCY_S}]")] | None = None
    namespace: str = ""
    scan_frame: str = "base_scan"
    scan_yaw: Finite | None = None
    wheel_speeds: Annotated[str, OneOf(WHEEL_SPEEDS)] = WHEEL_SPEEDS[0]

    @property
    def silent_s(self) -> float:
        """`silence_s`, or its default."""
        return 0.5 if self.silence_s is None else self.silence_s

    def in_namespace(self, topic: str) -> str:
        """Return a topic's full name."""
        topic = f"/{topic.lstrip('/')}"
        return f"/{self.namespace.strip('/')}{topic}" if self.namespace.strip("/") else topic


@dataclass(frozen=True)
class Qos:
    """How messages are kept and delivered, in ROS 2's words.

    Attributes:
        depth: messages that are kept; 0: all until they are taken. Beyond 10,000 a reliable publisher waits.
        reliable: whether what is lost is sent again.
        transient_local: whether those that come later receive what was sent before.
    """

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False

    def of_dds(self, *user_data: bytes) -> Any:
        """Return it for Cyclone DDS."""
        from cyclonedds.qos import Policy
        from cyclonedds.qos import Qos as DdsQos

        reliability = Policy.Reliability
        return DdsQos(
            reliability.Reliable(100_000_000) if self.reliable else reliability.BestEffort,
            Policy.Durability.TransientLocal if self.transient_local else Policy.Durability.Volatile,
            Policy.History.KeepLast(self.depth) if self.depth else Policy.History.KeepAll,
            *(() if self.depth else (Policy.ResourceLimits(_MOST_KEPT, -1, _MOST_KEPT),)),
            *[Policy.Userdata(data) for data in user_data],
        )

    def serves(self, wanted: "Qos") -> bool:
        """Return whether messages that a publisher keeps like this pass to a subscription that wants them so."""
        return self.reliable >= wanted.reliable and self.transient_local >= wanted.transient_local

    def __str__(self) -> str:
        """Return it in words."""
        kept = ", transient local" if self.transient_local else ""
        return f"{'reliable' if self.reliable else 'best effort'}{kept}"


SENSOR_DATA = Qos(5, reliable=False)
"""ROS 2's SensorDataQoS. Streams are received by it, also from reliable publishers: a reliable subscription of Cyclone
DDS 11.0.1 that joins late gets the first message of a Fast DDS publisher 3 s later."""
EVERY = Qos(0)
"""What must not be lost, whatever comes after it: an emergency stop, a goal."""
LATCHED = Qos(1, transient_local=True)
"""What is sent once and holds, such as ``/tf_static``."""


def require_cyclonedds() -> None:
    """Raise unless the extra of live ROS 2 is installed."""
    try:
        import cyclonedds.core  # noqa: F401
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            "Live ROS 2 needs the packages cyclonedds and rosbags, which cannot be imported "
            f"({error}). {install_extra('ros2')}"
        ) from error
