"""The stand-in for a robot: its room, and that it has the faults that are asked for."""

import contextlib
import math
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.ros2.peer_env import HERE, Peer


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Import the room, which needs no ROS."""
    monkeypatch.syspath_prepend(str(HERE / "peers"))
    import room

    yield room
    del sys.modules["room"]


def test_the_nearest_of_many_rays_is_the_clearance(room: Any) -> None:
    world, random = room.Room(), np.random.default_rng(0)
    angles = np.linspace(0, math.tau, 5_000)
    for x, y in random.uniform(-1.9, 1.9, (100, 2)):
        if (clearance := world.clearance(x, y)) > 0:
            assert world.ranges(x, y, angles).min() == pytest.approx(clearance, abs=1e-3)


def test_a_base_that_is_driven_into_a_wall_counts_one_contact_and_stays_in_the_room(room: Any) -> None:
    base = room.Base(room.Room(), x=0.0, y=-0.6, command=(0.2, 0.0))
    for _ in range(1500):
        base.step(0.01)
    assert base.contacts == 1
    assert base.x == pytest.approx(2.0 - room.BODY_RADIUS, abs=0.01)
    base.command = (-0.2, 0.0)
    for _ in range(100):
        base.step(0.01)
    assert base.contacts == 1
    assert base.x < 1.8


@pytest.mark.thorough
def test_the_standin_has_the_faults_that_are_asked_for(domain: int) -> None:
    faults = (
        "--nan=scan:0:999",
        "--frame=odom:map",
        "--zero-stamp=imu",
        "--clock-jump=0:3600",
        "--silence=battery_state:2",
        "--swap=joint_states:3",
    )
    topics = {
        "scan": "sensor_msgs/msg/LaserScan",
        "odom": "nav_msgs/msg/Odometry",
        "imu": "sensor_msgs/msg/Imu",
        "joint_states": "sensor_msgs/msg/JointState",
        "battery_state": "sensor_msgs/msg/BatteryState",
    }
    with Peer("standin_turtlebot3.py", *faults, domain=domain) as robot, contextlib.ExitStack() as stack:
        robot.wait(lambda line: line.get("published", {}).get("odom", 0) > 60)
        echoes = {
            name: stack.enter_context(Peer("topic.py", "echo", f"/{name}", kind, "--best-effort", domain=domain))
            for name, kind in topics.items()
        }
        joints = echoes["joint_states"]
        joints.wait(lambda _: len(joints.events("message")) >= 12)
        heard = {
            name: echo.wait_event("message")["message"] for name, echo in echoes.items() if name != "battery_state"
        }
        assert not echoes["battery_state"].events("message")
        published = robot.lines[-1]["published"]
    assert set(heard["scan"]["ranges"]) == {"nan"}
    assert heard["odom"]["header"]["frame_id"] == "map"
    assert heard["imu"]["header"]["stamp"] == {"sec": 0, "nanosec": 0}
    assert heard["joint_states"]["header"]["stamp"]["sec"] > time.time() + 3000
    stamps = [line["message"]["header"]["stamp"] for line in joints.events("message")]
    times = [stamp["sec"] + stamp["nanosec"] * 1e-9 for stamp in stamps]
    assert times != sorted(times)
    assert 0 < published["battery_state"] < published["odom"]


def test_a_peer_that_does_not_listen_to_sigint_is_killed(domain: int) -> None:
    with Peer("topic.py", "list", domain=domain) as peer:
        peer.wait_event("list")
        peer.signal(signal.SIGSTOP)
        assert peer.stop() == 0  # SIGCONT comes first
    with Peer("topic.py", "list", domain=domain) as peer:
        assert peer.stop(seconds=0) in (-signal.SIGKILL, -signal.SIGINT, 0)
