"""The peers against one another: what they say of ours is worth what they say of each other."""

import contextlib
import json
import math
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.ros2 import peer_env
from tests.ros2.peer_env import HERE, Peer
from tests.waiting import until

LDS01 = ("/scan", "sensor_msgs/msg/LaserScan", "--best-effort")


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


def log_of(path: Path, event: str) -> list[dict[str, Any]]:
    return [line for line in map(json.loads, path.read_text().splitlines()) if line["event"] == event]


@pytest.mark.parametrize(
    ("robot", "brain", "options"),
    [("kilted", "kilted", ()), ("jazzy", "kilted", ("--lidar=lds02",)), ("kilted", "jazzy", ("--twist",))],
)
@pytest.mark.thorough
def test_the_avoidance_node_drives_the_standin_without_contact(
    robot: str, brain: str, options: tuple[str, ...], domain: int, tmp_path: Path
) -> None:
    twist = ["--twist"] if "--twist" in options else []
    log = tmp_path / "robot.jsonl"
    standin = Peer(
        *("standin_turtlebot3.py", "--pose=0.9:-0.6:0", "--wait", "--log", log, *options),
        **{"domain": domain, "distribution": robot},
    )
    with standin, Peer("avoidance_node.py", *twist, domain=domain, distribution=brain) as driver:
        driver.wait(lambda line: line.get("scans", 0) >= 90, "90 scans, 18 s")
        assert driver.stop() == 0
        until(lambda: log_of(log, "command")[-1]["given"] == [0.0, 0.0], "the zero at the end has come")
    last = driver.lines[-1]
    assert last["turning"] > 0
    assert last["without_reading"] == 0
    assert log_of(log, "pose")[-1]["contacts"] == 0
    driven = np.diff([line["pose"][:2] for line in log_of(log, "pose")], axis=0)
    assert np.hypot(*driven.T).sum() > 0.5
    assert len(log_of(log, "command")) >= 0.9 * last["commands"]


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
    with Peer("standin_turtlebot3.py", *faults, "--old-twist", domain=domain) as robot, contextlib.ExitStack() as stack:
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
    assert abs(heard["odom"]["twist"]["twist"]["linear"]["x"]) < 1e-6
    assert heard["imu"]["header"]["stamp"] == {"sec": 0, "nanosec": 0}
    assert heard["joint_states"]["header"]["stamp"]["sec"] > time.time() + 3000
    stamps = [line["message"]["header"]["stamp"] for line in joints.events("message")]
    times = [stamp["sec"] + stamp["nanosec"] * 1e-9 for stamp in stamps]
    assert times != sorted(times)
    assert 0 < published["battery_state"] < published["odom"]


@pytest.mark.thorough
def test_a_restart_is_another_participant_where_the_robot_stood(domain: int) -> None:
    with Peer("standin_turtlebot3.py", "--pose=1:0:0", "--restart=1:0.5", domain=domain) as robot:
        robot.wait_event("restart")
        until(lambda: len(robot.events("ready")) == 2, "the second life is ready")
        first, second = robot.events("ready")
        assert first["pid"] != second["pid"]
        again = robot.wait(lambda line: line["event"] == "report" and line["monotonic"] > second["monotonic"])
        assert again["pose"][:2] == [1.0, 0.0]
        assert robot.stop() == 0


@pytest.mark.thorough
@pytest.mark.parametrize("distribution", peer_env.DISTRIBUTIONS)
@pytest.mark.parametrize("answers", [0, 1, 2])
def test_the_brain_counts_the_results_of_each_of_its_goals(distribution: str, answers: int, domain: int) -> None:
    peer_env.environment(distribution, messages=True)
    goals = ("--goal=1,2,0.5", "--goal=-1,0,0", "--patience=2", "--linger=1")
    with (
        Peer("echo_cerebellum.py", "--answers", answers, domain=domain, distribution=distribution) as robot,
        Peer("brain_node.py", *goals, domain=domain, distribution=distribution) as brain,
    ):
        summary = brain.wait_event("summary")
        assert brain.stop() == 0
    assert [line["position"] for line in robot.events("command")] == [[1.0, 2.0, 0.0], [-1.0, 0.0, 0.0]]
    counts = {name: summary[name] for name in ("sent", "once", "twice", "never", "unknown")}
    assert counts == {
        "sent": 2,
        "once": 2 * (answers == 1),
        "twice": 2 * (answers == 2),
        "never": 2 * (answers == 0),
        "unknown": 0,
    }
    assert summary["states"] > 10


def trajectory(end: list[float], *, seconds: int) -> str:
    """Return a trajectory whose joints come in an order that is neither the arm's nor that of /joint_states."""
    names = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    point = {"positions": end[::-1], "velocities": [0.0] * 6, "time_from_start": {"sec": seconds}}
    return json.dumps({"joint_names": [f"{name}_joint" for name in reversed(names)], "points": [point]})


@pytest.mark.thorough
def test_the_arm_follows_a_trajectory_by_the_joints_names_and_refuses_what_is_not_active(domain: int) -> None:
    end = [0.1, -1.2, 1.1, -1.0, -1.3, 0.2]
    with Peer("ur_driver_standin.py", domain=domain) as arm:
        for topic, kind, values in (
            ("/forward_position_controller/commands", "std_msgs/msg/Float64MultiArray", json.dumps({"data": end})),
            (
                "/scaled_joint_trajectory_controller/joint_trajectory",
                "trajectory_msgs/msg/JointTrajectory",
                trajectory(end, seconds=1),
            ),
        ):
            with Peer("topic.py", "pub", topic, kind, values, "--count=1", domain=domain) as sender:
                assert sender.wait_event("sent")["count"] == 1
        arm.wait(lambda line: line.get("position") == pytest.approx(end, abs=1e-3), "the end of the trajectory")
        assert arm.lines[-1]["refused"] == 1
        with Peer(
            "topic.py", "echo", "/joint_states", "sensor_msgs/msg/JointState", "--count=1", domain=domain
        ) as echo:
            message = echo.wait_event("message")["message"]
    assert message["name"][-1] == "shoulder_pan_joint"
    assert message["position"] == pytest.approx([*end[1:], end[0]], abs=1e-3)


@pytest.mark.thorough
def test_the_plain_pair_measures_every_topic(domain: int) -> None:
    options = ("--set=turtlebot3", "--warm-up=0.5", "--measure=2")
    with (
        Peer("plain_pair.py", "subscribe", *options, domain=domain) as subscriber,
        Peer("plain_pair.py", "publish", *options, domain=domain) as publisher,
    ):
        topics = subscriber.wait_event("summary")["topics"]
        shares = [half.wait_event("processor")["share"] for half in (subscriber, publisher)]
        assert subscriber.stop() == publisher.stop() == 0
    assert set(topics) == {"scan", "odom", "imu", "joint_states", "battery_state"}
    for measured in topics.values():
        assert measured["messages"] > 2
        assert 0 < measured["latency_p50"] <= measured["latency_p99"]
    assert all(0 < share < 2 for share in shares)


def test_a_peer_that_does_not_listen_to_sigint_is_killed(domain: int) -> None:
    with Peer("topic.py", "list", domain=domain) as peer:
        peer.wait_event("list")
        peer.signal(signal.SIGSTOP)
        assert peer.stop() == 0  # SIGCONT comes first
    with Peer("topic.py", "list", domain=domain) as peer:
        assert peer.stop(seconds=0) in (-signal.SIGKILL, -signal.SIGINT, 0)
