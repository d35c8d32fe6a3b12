"""Configurations of `bhd-ros2 serve` and `bhd-ros2 bridge`."""

from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar

from lerobot.robots.config import RobotConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, OneOf, Options, Range
from bhd_lerobot.recording.config import PassiveRecordConfig
from bhd_lerobot.robots.config import BhdRobotConfig
from bhd_lerobot.robots.config_mobile_arm import MobileArmConfig
from bhd_lerobot.ros2.live.network import DISTROS, Domain, NetworkConfig


def is_served(kind: type) -> bool:
    """Return whether robots of a configuration have topics of their own: a base has, and an arm on a table."""
    return issubclass(kind, BhdRobotConfig) and not issubclass(kind, MobileArmConfig)


@dataclass
class ServiceConfig(Options):
    """A robot on the wall clock with a node, until it is ended.

    Attributes:
        robot: the robot.
        network: where other nodes are.
        namespace: of the robot's node; topics keep their names, which begin with a slash.
        state_hz: how often ``/cerebellum/state`` is published [Hz].
        duration_s: end after this time [s]; 0: run until Ctrl-C.
        articles: topics under the names of the articles as well: ``true``, or the folder of your own package of
            messages (`package.xml` and `msg/`), whose fields are found by their names.
    """

    taken: ClassVar = {"robot": is_served}  # of all types that there are

    robot: RobotConfig
    network: NetworkConfig = field(default_factory=NetworkConfig)
    namespace: str = "/"
    state_hz: Annotated[float, Range("(0, 1000]")] = 50.0
    duration_s: NotNegative = 0.0
    articles: bool | str = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.robot, MobileArmConfig):
            raise ConfigError(
                f"robot.type is {self.robot.type!r}, an arm on a base, for which bhd-ros2 has no topics. Valid: a base "
                "or an arm on a table, such as turtlebot3 or ur5."
            )


@dataclass
class ServeConfig(ServiceConfig):
    """A simulated robot as a ROS 2 robot, on the wall clock. Ctrl-C ends it.

    Attributes:
        robot: the robot, one that this package simulates.
        joint_states_hz: how often an arm's ``/joint_states`` is published [Hz].
        clock: publish ``/clock`` as well.
        view: show the simulation in MuJoCo's viewer, a window on this machine. Closing the window does not end the
            robot.
        foxglove_port: serve all topics to the Foxglove app on this TCP port of this machine; 0: off.
    """

    joint_states_hz: Annotated[float, Range("(0, 1000]")] = 125.0  # of a UR5 (CB3); a UR5e has 500
    clock: bool = False
    view: bool = False
    foxglove_port: Annotated[int, Range("[0, 65535]")] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        robot: Any = self.robot
        if not hasattr(robot, "plant") or robot.plant:
            raise ConfigError(
                f"robot.type is {robot.type!r}; what can be served is a simulated robot: turtlebot3 or ur5, without "
                "robot.plant."
            )
        robot.clock = "realtime"
        if robot.body().drive is not None:
            robot.odometry = robot.imu = True
        elif robot.action_space != "joint":
            raise ConfigError("robot.action_space is not 'joint'; a served arm takes joint positions.")


@dataclass(frozen=True)
class BrainNetworkConfig(Options, prefix="network."):
    """The network of the brains in front of a bridge. What is not given is that of `robot.ros2`.

    Attributes:
        domain: number of the ROS domain.
        interface: network interface or address; ``lo`` is the loopback interface, ``auto`` what Cyclone DDS prefers.
        peers: addresses of further machines, for networks without multicast.
        distro: whose interfaces are used where distributions differ: ``jazzy`` (and later) or ``humble``.
    """

    domain: Domain | None = None
    interface: str | None = None
    peers: list[str] | None = None
    distro: Annotated[str, OneOf(DISTROS)] | None = None


@dataclass
class BridgeConfig(ServiceConfig):
    """The cerebellum in front of a robot, between it and a brain on a ROS 2 network. Ctrl-C stops the robot.

    Attributes:
        robot: the robot; `robot.plant` says how it is driven.
        network: where brains are; an option that is not given is that of `robot.ros2`.
        namespace: of the bridge's node; topics keep their names, which begin with a slash.
        record: what is recorded, and where.
    """

    network: BrainNetworkConfig = field(default_factory=BrainNetworkConfig)  # type: ignore[assignment]
    record: PassiveRecordConfig = field(default_factory=PassiveRecordConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        robot: Any = self.robot
        if not getattr(robot, "plant", ""):
            raise ConfigError(
                "robot.plant is not given; a bridge is in front of a robot that a plant drives: turtlebot3 or ur5 with "
                "--robot.plant=ros2, or with a class, package.module:Class. `bhd-ros2 serve` serves a simulated robot."
            )
        if robot.body().drive is not None:
            robot.odometry = True  # a goal is reached by it
        elif robot.action_space != "joint":
            raise ConfigError(f"robot.action_space is {robot.action_space!r}; a bridge takes joint positions: 'joint'.")
        given = {name: value for name, value in vars(self.network).items() if value is not None}
        of_robot = {one.name: getattr(robot.ros2, one.name) for one in fields(NetworkConfig)}
        self.network = NetworkConfig(**of_robot | given)  # type: ignore[assignment]
