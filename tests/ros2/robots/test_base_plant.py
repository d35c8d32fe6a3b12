"""A TurtleBot3 below our plant, by rclpy or made up: what it reads, what it names, and when the robot stops."""

import json
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.messages.scan import ScanReader
from bhd_lerobot.ros2.robots.base_plant import BasePlant
from tests.cases import each_case
from tests.ros2.feed import JOINTS, SCAN, Sent, feed, head, scan
from tests.ros2.peer_env import Peer, free_domain
from tests.waiting import until

FORWARD = np.array([[0.1, 0.0]])
STAMPED, STRING = "geometry_msgs/msg/TwistStamped", "std_msgs/msg/String"


def make(domain: int, *, imu: bool = True, **options: Any) -> BasePlant:
    network = Ros2Config(domain=domain, **{"silence_s": 5.0, **options})
    return BasePlant(SimpleNamespace(beams=360, imu=imu, ros2=network), turtlebot3_burger())


def reading() -> PlantReading:
    out = PlantReading(1, 2, 363)
    out.stamp_ns = np.zeros(1, np.int64)
    return out


def test_nothing_is_commanded_before_commands_are_let_through() -> None:
    sent: list[np.ndarray] = []
    plant: Any = make(0)
    plant.link = SimpleNamespace(write=sent.append)
    plant.write(FORWARD)
    assert not sent
    plant.enable()
    plant.write(FORWARD)
    assert len(sent) == 1


@pytest.fixture(scope="module")
def shared() -> Iterator[int]:
    """The domain of a robot that all tests have, which none may end."""
    with free_domain() as domain:
        yield domain


@pytest.fixture(scope="module")
def robot(shared: int) -> Iterator[Peer]:
    with Peer("standin_turtlebot3.py", "--open", "--half=50", domain=shared) as peer:
        peer.wait_event("ready")
        yield peer


@pytest.fixture
def plant(robot: Peer, shared: int) -> Iterator[BasePlant]:
    with closing(make(shared)) as made:
        made.open()
        made.enable()
        yield made


def drive(plant: BasePlant, goes_on: Callable[[], object], what: str) -> None:
    """Write commands as the cerebellum does, until something has come about."""

    def step() -> object:
        plant.write(FORWARD)
        return goes_on()

    until(step, what)


def fails(plant: BasePlant, match: str) -> None:
    """Read until the plant raises."""
    with pytest.raises(RealtimeError, match=match):
        until(lambda: [plant.read(reading()), False][1], "it is noticed")


def moves(robot: Peer) -> bool:
    return bool(robot.events("report")) and abs(robot.events("report")[-1]["twist"][0]) > 0.05


def stands(robot: Peer) -> bool:
    report = robot.events("report")[-1]
    return report["twist"] == [0.0, 0.0] and report["command"] == [0.0, 0.0]


def test_it_reads_and_drives_the_robot_and_stops_it_when_commands_cease_and_when_it_is_closed(robot, plant, shared):
    out = reading()
    plant.read(out)
    now = time.monotonic_ns()
    assert 0 < now - int(out.stamp_ns[0]) < 5e9  # type: ignore[index]
    assert 0 < now - int(out.sensors_ns[0]) < 5e9
    assert np.isfinite(out.sensors).all()
    assert 0.12 <= out.sensors[0, :360].min() <= out.sensors[0, :360].max() <= 3.5
    before = out.position.copy()
    refused = f"Another program of this machine commands /cmd_vel in ROS domain {shared}"
    with pytest.raises(RealtimeError, match=refused):
        make(shared).open()
    drive(plant, lambda: [plant.read(out), moves(robot) and (out.position > before).all()][1], "the robot moves")
    # turtlebot3_node gives wheel speeds in m/s; here they are in rad/s: 0.1 m/s on wheels of 33 mm.
    until(lambda: [plant.write(FORWARD), plant.read(out), out.velocity.min() > 2.5][2], "both wheels turn at 3 rad/s")
    np.testing.assert_allclose(out.velocity, 0.1 / 0.033, rtol=0.1)
    until(lambda: stands(robot), "the robot stands without commands")
    drive(plant, lambda: moves(robot), "the robot moves again")
    plant.close()
    until(lambda: stands(robot), "the robot stands after the plant was closed")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.thorough(but=1)
def test_it_stops_when_the_node_is_killed_or_stopped(robot: Peer, plant: BasePlant, number: int) -> None:
    drive(plant, lambda: moves(robot), "the robot moves")
    os.kill(plant.link.pids["node"], number)
    with pytest.raises(RealtimeError, match=r"node (ended with status -9|is stopped)"):
        until(lambda: [plant.write(FORWARD), plant.read(reading()), False][2], "it is noticed")
    until(lambda: stands(robot), "the guard stops the robot")
    if number == signal.SIGSTOP:
        os.kill(plant.link.pids["node"], signal.SIGCONT)


def test_the_robot_is_stopped_when_all_processes_are_asked_to_end_at_once(robot: Peer, plant: BasePlant) -> None:
    """As at a shutdown of the computer: what commands the robot ends, and its node stops it."""
    drive(plant, lambda: moves(robot), "the robot moves")
    for pid in plant.link.pids.values():
        os.kill(pid, signal.SIGTERM)
    until(lambda: stands(robot), "the robot stands")


def test_another_robot_of_its_name_another_node_that_commands_it_and_a_guard_that_is_gone_are_faults(plant, shared):
    def is_well() -> bool:
        return not plant.link.problem

    with Peer("standin_turtlebot3.py", domain=shared):
        fails(plant, r"Several nodes send /(joint_states|scan|imu) at a time: .*two robots")
    until(is_well, "the other robot has left")
    with Peer("avoidance_node.py", domain=shared):
        fails(plant, r"Another node commands the robot: /cmd_vel by (/avoidance_node|an unnamed node)")
    until(is_well, "the other node has left")
    os.kill(plant.link.pids["guard"], signal.SIGKILL)
    fails(plant, "guard ended with status -9")


def test_a_silent_topic_and_a_robot_that_is_gone_are_named(domain: int) -> None:
    plant = make(domain, silence_s=1.0)
    with Peer("standin_turtlebot3.py", "--silence=scan", domain=domain) as robot:
        robot.wait_event("ready")
        try:
            plant.open()
            robot.signal(signal.SIGUSR1)
            fails(plant, "/scan has sent no message for")
            robot.signal(signal.SIGKILL)
            gone = ("/joint_states has sent no message for", "Nobody publishes /joint_states")
            until(lambda: plant.link.problem.startswith(gone), "it is named")
        finally:
            plant.close()


def test_stamps_of_zero_and_of_tomorrow_are_of_another_clock_and_nan_is_read_as_it_is(domain: int) -> None:
    """The check of all readings above the plants finds what is no number."""
    out = PlantReading(1, 2, 360)
    out.stamp_ns = np.zeros(1, np.int64)
    stamps, values = (
        ("--zero-stamp=joint_states", "--clock-offset=86400"),
        ("--nan=joint_states:0:999", "--nan=scan:0:999"),
    )
    with (
        Peer("standin_turtlebot3.py", *stamps, *values, domain=domain),
        closing(make(domain, imu=False, silence_s=1.0)) as plant,
    ):
        plant.open()
        before = int(plant.state()["count"][0])
        until(lambda: plant.state()["count"][0] > before + 5, "five more joint states")
        plant.read(out)
        for arrived_ns, stamp_ns in zip(plant.state()["arrived_ns"], (out.stamp_ns[0], out.sensors_ns[0]), strict=True):
            assert 0 < arrived_ns - stamp_ns + 1 < 1e9
        assert np.isnan(out.position).all()
        np.testing.assert_array_equal(out.sensors, 3.5)  # a reading that is none is no return


WHEELS = {
    "name": ["wheel_left_joint", "wheel_right_joint"],
    "position": np.array([[1.0, 2.0]]),
    "velocity": np.zeros((1, 2)),
}
RANGES = np.ones(360)
STILL = {"angle_increment": np.zeros(1)}
UNUSABLE: dict[str, tuple[str, dict[str, Any], dict[str, Any], str]] = {  # joints, what is another about the scan, text
    "no ranges": (JOINTS, WHEELS, {"ranges": np.zeros((1, 0), np.float32)}, "the scan has 0 ranges"),
    "no angles": (JOINTS, WHEELS, STILL, "/scan cannot be used: .*angle"),
    "too many": (
        JOINTS,
        WHEELS,
        {"ranges": np.ones((1, 100_000), np.float32)},
        "100000 ranges; at most 10000 are read",
    ),
    "another frame": (JOINTS, WHEELS, {"header": head("laser")}, "frame 'laser', whose rotation in the robot is not"),
    "no joints": (JOINTS, {}, {}, "cannot be used: name has no 'wheel_left_joint'; it has nothing"),
    "no JointState": (STRING, {}, {}, f"/robot is of type {STRING}; .* of {JOINTS}"),
}


@pytest.mark.parametrize("what", UNUSABLE)
@pytest.mark.thorough(but=3)
def test_what_cannot_be_used_is_named(what: str, domain: int) -> None:
    msgtype, wheels, changed, text = UNUSABLE[what]

    def sent(_: float) -> list[Sent]:
        stamped = {"header": head()} if msgtype == JOINTS else {}
        return [("/joint_states", msgtype, wheels | stamped), ("/scan", SCAN, scan(RANGES) | changed)]

    with (
        feed(domain, sent, receives=(("/cmd_vel", STAMPED),)),
        closing(make(domain, imu=False, silence_s=1.0)) as plant,
    ):
        plant.link.open(None)
        until(lambda: re.search(text, plant.link.problem), "it is named")


def test_a_flood_is_read(domain: int) -> None:
    out = PlantReading(1, 2, 360)
    values = json.dumps({name: np.ravel(value).tolist() for name, value in WHEELS.items()})
    flood = ("pub", "/joint_states", JOINTS, values, "--hz=1000", "--burst=10")
    with (
        feed(domain, lambda _: [("/scan", SCAN, scan(RANGES))], hz=5, receives=(("/cmd_vel", STAMPED),)),
        Peer("topic.py", *flood, domain=domain),
        closing(make(domain, imu=False, silence_s=1.0)) as plant,
    ):
        plant.link.open(patience_s=30.0)
        plant.read(out)
        np.testing.assert_array_equal(out.position, [[1.0, 2.0]])
        count = plant.state()["count"][0]
        until(lambda: plant.state()["count"][0] > count + 1000, "a thousand more joint states")


def test_a_network_with_nobody_is_named(domain: int, capsys: pytest.CaptureFixture[str]) -> None:
    plant = make(domain)
    where = rf"Nobody publishes /joint_states .* in ROS domain {domain} on 'lo'\..*No node publishes anything.*domain"
    for patience_s in (3.0, 10.0, 30.0):  # a node on a busy machine may not have looked around yet
        with pytest.raises(RealtimeError) as failed:
            plant.link.open(patience_s)
        if re.search(where, str(failed.value)):
            break
    assert re.search(where, str(failed.value))
    plant.close()
    assert "Waiting for the robot, " in capsys.readouterr().err


def test_a_namespace_and_another_scanner() -> None:
    plant = make(1, namespace="tb3_1", scan_frame="laser")
    assert [one.topic for one in plant.link.spec.inputs] == ["/tb3_1/joint_states", "/tb3_1/scan", "/tb3_1/imu"]
    assert [one.topic for one in plant.link.spec.outputs] == ["/tb3_1/cmd_vel"]
    reader = plant.link.spec.inputs[1].reader
    assert isinstance(reader, ScanReader)
    assert (reader.topic, reader.frame) == ("/tb3_1/scan", "laser")


@pytest.mark.law
def test_wheels_speeds_have_the_unit_that_is_stated_and_a_wrong_one_is_named() -> None:
    """Those of turtlebot3_node are in m/s, those of Gazebo in rad/s."""

    def read(unit: str, speed: float) -> float:
        out = PlantReading(1, 2, 360)
        values = np.array([1.0, 2.0, speed, -speed, *np.ones(360)])
        make(1, imu=False, wheel_speeds=unit).read_parts({"values": values, "measured_ns": np.zeros(2)}, out)
        assert out.velocity[0, 1] == -out.velocity[0, 0]
        return float(out.velocity[0, 0])

    assert read("m/s", 0.1) == pytest.approx(read("rad/s", 0.1 / 0.033)) == pytest.approx(0.1 / 0.033)
    with pytest.raises(RealtimeError, match=r"A wheel turns at 92 rad/s by /joint_states, .*wheel_speeds=rad/s"):
        read("m/s", 0.1 / 0.033)


@pytest.mark.law
@pytest.mark.parametrize(("silent_s", "before"), [(20.0, 99.6), (0.05, 0.0)])
def test_wheels_that_their_driver_counts_anew_after_a_silence_have_not_turned(silent_s: float, before: float) -> None:
    """The odometry goes on where it was. Without a silence it is a false reading, which others have to see."""
    plant, out, clock, turned = make(1, imu=False), PlantReading(1, 2, 360), 0, []
    for elapsed_s, angle in ((0.0, 99.0), (0.05, 99.3), (0.05, 99.6), (silent_s, 0.0), (0.05, 0.3), (0.05, 0.1)):
        clock += round(elapsed_s * 1e9)
        state = {"values": np.array([angle, -angle, 0.0, 0.0, *np.ones(360)]), "measured_ns": np.full(2, clock)}
        plant.read_parts(state, out)
        turned.append(out.position[0].tolist())
    assert np.allclose(turned, np.outer([99.0, 99.3, 99.6, before, before + 0.3, before + 0.1], [1.0, -1.0]))


@each_case(
    ("options", "brain_s", "plant_s"),
    [
        ({}, 0.2, 0.5),
        ({"ros2": Ros2Config(timeout_s=0.4, silence_s=1.0)}, 0.4, 1.0),
        ({"realtime": RealtimeConfig(brain_timeout_s=20.0)}, 20.0, 0.5),
        ({"realtime": RealtimeConfig(brain_timeout_s=0.5)}, 0.5, 0.5),
    ],
)
def test_the_brain_of_a_ros_robot_is_waited_for_as_long_as_its_commands(options, brain_s, plant_s):
    realtime = TurtleBot3Config(plant="ros2", **options).realtime
    assert (realtime.brain_timeout_s, realtime.plant_timeout_s) == (brain_s, plant_s)


@each_case(("options", "latency_s"), [({}, 0.3), ({"latency_s": 0.0}, 0.0), ({"latency_s": 0.7}, 0.7)])
def test_how_late_a_base_follows_is_an_option(options: dict[str, float], latency_s: float) -> None:
    plant = make(1, **options)
    assert plant.latency_s == latency_s
    assert "/cmd_vel" in plant.hint
