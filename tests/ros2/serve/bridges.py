"""Robots behind bridges, and bursts of goals, for tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.serve.interface import COMMAND_TOPIC
from tests.ros2.peer_env import Peer, environment
from tests.ros2.programs import Bridged, Side, newest_of

TWIST = "geometry_msgs/msg/Twist"
NEAR = ("--goal=0.5,0.1,0.4,0,1,0,0", "--goal=0.5,-0.1,0.4,0,1,0,0")  # of the UR5's tool
FORWARD, STAND = {"linear": {"x": 0.15}}, [0.0, 0.0]
COUNT = 100
BURSTS = {  # one goal that can be followed and one that cannot; why others than the first are refused or end early
    "turtlebot3": (("--goal=0.3,0,0", "--goal=nan,0,0"), ("took its place", "The target pose is")),
    "ur5": ((NEAR[0], "--goal=3,0,0.3,0,1,0,0"), ("goals wait already", "too far away")),
}


@contextmanager
def base(
    domain: int, folder: Path, *options: str, half: float = 2.0, **settings: Any
) -> Iterator[tuple[Side, Peer, Path]]:
    """A TurtleBot3 on an open floor, half of its width in metres, its bridge, and a brain's node."""
    log = folder / "robot.jsonl"
    with (
        Peer("standin_turtlebot3.py", "--open", f"--half={half}", "--log", log, domain=domain) as robot,
        Bridged("turtlebot3", *options, domain=domain, log=folder / "log", **settings) as bridge,
        Node("brain", NetworkConfig(domain=domain)) as node,
    ):
        yield Side(bridge, node), robot, log


@contextmanager
def arm(domain: int, folder: Path, *options: str, **settings: Any) -> Iterator[tuple[Side, Peer, Path]]:
    """A UR5 behind its driver, its bridge, and a brain's node."""
    environment(messages=True)
    log = folder / "robot.jsonl"
    with Peer("ur_driver_standin.py", "--log", log, domain=domain) as robot:
        robot.wait_event("ready")
        with (
            Bridged("ur5", *options, domain=domain, log=folder / "log", **settings) as bridge,
            Node("brain", NetworkConfig(domain=domain)) as node,
        ):
            yield Side(bridge, node), robot, log


def twist(log: Path) -> list[float]:
    twist: list[float] = newest_of(log, "pose")["twist"]
    return twist


def drives(side: Side, log: Path) -> bool:
    side.send("/brain/cmd_vel", TWIST, FORWARD)
    return twist(log)[0] > 0.1


def burst(side: Side, robot: str) -> None:
    """Let a real node send many goals at once: each has one result, and refused ones are counted."""
    environment(messages=True)
    (goals, causes), domain = BURSTS[robot], side.node.network.domain_number
    side.results.take()
    # A deeper queue than the usual ten: this process may wait for its turn while results come.
    with Peer("brain_node.py", *goals, f"--burst={COUNT}", f"--depth={COUNT}", domain=domain) as brain:
        summary = brain.wait_event("summary")
    counts = {key: summary[key] for key in ("sent", "once", "twice", "never", "unknown")}
    assert counts == {"sent": COUNT, "once": COUNT, "twice": 0, "never": 0, "unknown": 0}
    side.served.wait_for(f": {COMMAND_TOPIC}: ")
    results = side.ended(COUNT)
    assert any(one.success for one in results), results
    for cause in causes:
        assert any(cause in one.message for one in results if not one.success), cause
