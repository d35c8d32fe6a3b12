"""A robot's processes and its node, from the start to a clean stop: what `bhd-ros2 serve` and `bridge` share."""

import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from types import FrameType
from typing import Annotated, Any, ClassVar

import numpy as np
from lerobot.robots.config import RobotConfig
from rich.console import Console

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Options, Range
from bhd_lerobot.robots.config import BhdRobotConfig
from bhd_lerobot.robots.config_mobile_arm import MobileArmConfig
from bhd_lerobot.robots.host.realtime import LiveHost, make_live
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.viewer.viewer import viewed
from bhd_lerobot.ros2.live.network import NetworkConfig, require_cyclonedds
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.serve.server import Counts, Server, Topics


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


def run_service(
    config: ServiceConfig,
    simulation: type[Simulation],
    scene: Any,
    parts: Callable[[LiveHost, Node, Counts], list[Topics]],
    *,
    console: Console,
    ended: threading.Event | None = None,
    title: str,
    name: str = "",
    node: Callable[..., Node] = Node,
    view: bool = False,
) -> Any:
    """Run a robot and its topics until SIGINT, SIGTERM or SIGHUP; return the robot's last state.

    Args:
        scene: in which it starts; None: where it is.
        name: of the node; the robot's type if empty.

    Raises:
        RealtimeError: a process of the robot could not be started or has ended, or the network cannot be used.
    """
    require_cyclonedds()
    end, robot = ended or threading.Event(), config.robot
    is_shown = console.is_terminal

    def stop(number: int, _: FrameType | None) -> None:
        end.set()
        console.quiet |= is_shown and number == signal.SIGHUP  # the terminal is gone: it takes nothing any more

    with ExitStack() as running:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # as it is by nohup
                running.callback(signal.signal, number, signal.signal(number, stop))
        host = running.enter_context(closing(make_live(simulation, robot, robot.id)))
        running.enter_context(viewed(host, view))
        host.reset(np.zeros(1, np.intp), [scene], [getattr(robot, "seed", 0)])
        host.begin()
        for line in host.notes:
            console.print(line)
        made = running.enter_context(node(name or robot.type, config.network, config.namespace))
        counts = Counts()
        server = Server(host, made, parts(host, made, counts), counts)
        where = "this machine" if config.network.is_local else config.network.interface
        console.print(f"{robot.type} {title}: domain {config.network.domain_number}, {where}. Ctrl-C ends it.")
        if config.duration_s:
            timer = threading.Timer(config.duration_s, end.set)
            timer.daemon = True
            timer.start()
            running.callback(timer.cancel)
        # A log has one line for a message, whatever its length.
        server.run(end.is_set, lambda line: console.print(line, markup=False, soft_wrap=not console.is_terminal))
        console.print(f"Ended. Commands refused: {sum(counts.refused.values())}.")
        return host.bridge.latest.copy()
