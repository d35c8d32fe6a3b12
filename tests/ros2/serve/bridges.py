"""Robots behind bridges, for tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from tests.ros2.peer_env import Peer, environment
from tests.ros2.programs import Bridged, Side, log_of

TWIST = "geometry_msgs/msg/Twist"
NEAR = ("--goal=0.5,0.1,0.4,0,1,0,0", "--goal=0.5,-0.1,0.4,0,1,0,0")  # of the UR5's tool
FORWARD, STAND = {"linear": {"x": 0.15}}, [0.0, 0.0]


@contextmanager
def base(domain: int, folder: Path, *options: str, **settings: Any) -> Iterator[tuple[Side, Peer, Path]]:
    """A TurtleBot3 on an open floor, its bridge, and a brain's node."""
    log = folder / "robot.jsonl"
    with (
        Peer("standin_turtlebot3.py", "--open", "--log", log, domain=domain) as robot,
        Bridged("turtlebot3", *options, domain=domain, log=folder / "log", **settings) as bridge,
        Node("brain", NetworkConfig(domain=domain)) as node,
    ):
        yield Side(bridge, node), robot, log


@contextmanager
def arm(domain: int, folder: Path, *options: str, **settings: Any) -> Iterator[tuple[Bridged, Peer, Path]]:
    """A UR5 behind its driver, and its bridge."""
    environment(messages=True)
    log = folder / "robot.jsonl"
    with Peer("ur_driver_standin.py", "--log", log, domain=domain) as robot:
        robot.wait_event("ready")
        with Bridged("ur5", *options, domain=domain, log=folder / "log", **settings) as bridge:
            yield bridge, robot, log


def twist(log: Path) -> list[float]:
    twist: list[float] = log_of(log, "pose")[-1]["twist"]
    return twist


def drives(side: Side, log: Path) -> bool:
    side.send("/brain/cmd_vel", TWIST, FORWARD)
    return twist(log)[0] > 0.1
