"""A stand-in for a real TurtleBot3, by rclpy, below our plant: what it reads, and when the robot stops."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.messages.scan import ScanReader
from bhd_lerobot.ros2.robots.base_plant import BasePlant
from tests.ros2.peer_env import Peer
from tests.waiting import until

FORWARD = np.array([[0.1, 0.0]])
_SOON_S = 10.0  # far longer than a stop takes, for a busy machine


def make(domain: int, **options: float) -> BasePlant:
    network = Ros2Config(domain=domain, **{"silence_s": 5.0, **options})  # type: ignore[arg-type]
    return BasePlant(SimpleNamespace(beams=360, imu=True, ros2=network), turtlebot3_burger())


def reading() -> PlantReading:
    out = PlantReading(1, 2, 363)
    out.stamp_ns = np.zeros(1, np.int64)
    return out


@pytest.fixture
def robot(domain: int) -> Iterator[Peer]:
    with Peer("standin_turtlebot3.py", "--open", domain=domain) as peer:
        peer.wait_event("ready")
        yield peer


@pytest.fixture
def plant(robot: Peer, domain: int) -> Iterator[BasePlant]:
    made = make(domain)
    made.open()
    try:
        made.enable()
        yield made
    finally:
        made.close()


def drive(plant: BasePlant, goes_on: Callable[[], object], what: str) -> None:
    """Write commands as the cerebellum does, until something has come about."""

    def step() -> object:
        plant.write(FORWARD)
        return goes_on()

    until(step, what)


def moves(robot: Peer) -> bool:
    return bool(robot.events("report")) and abs(robot.events("report")[-1]["twist"][0]) > 0.05


def stands(robot: Peer) -> bool:
    report = robot.events("report")[-1]
    return report["twist"] == [0.0, 0.0] and report["command"] == [0.0, 0.0]


def test_it_reads_what_the_robot_measures_and_drives_it(robot: Peer, plant: BasePlant) -> None:
    out = reading()
    plant.read(out)
    now = time.monotonic_ns()
    assert 0 < now - int(out.stamp_ns[0]) < 5e9
    assert 0 < now - int(out.sensors_ns[0]) < 5e9
    assert np.isfinite(out.sensors).all()
    assert 0.12 <= out.sensors[0, :360].min() <= out.sensors[0, :360].max() <= 3.5
    before = out.position.copy()
    drive(plant, lambda: moves(robot), "the robot moves")
    plant.read(out)
    assert (out.position > before).all()
    # turtlebot3_node gives wheel speeds in m/s; here they are in rad/s: 0.1 m/s on wheels of 33 mm.
    until(lambda: [plant.write(FORWARD), plant.read(out), out.velocity.min() > 2.5][2], "both wheels turn at 3 rad/s")
    np.testing.assert_allclose(out.velocity, 0.1 / 0.033, rtol=0.1)


def test_it_stops_when_commands_cease_and_when_it_is_closed(robot: Peer, plant: BasePlant) -> None:
    drive(plant, lambda: moves(robot), "the robot moves")
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


def test_a_guard_that_is_gone_is_a_fault(robot: Peer, plant: BasePlant) -> None:
    os.kill(plant.link.pids["guard"], signal.SIGKILL)
    with pytest.raises(RealtimeError, match="guard ended with status -9"):
        until(lambda: [plant.read(reading()), False][1], "it is noticed")


def test_a_robot_that_is_gone_is_named(robot: Peer, plant: BasePlant) -> None:
    robot.signal(signal.SIGKILL)
    with pytest.raises(RealtimeError, match=r"/(joint_states|imu|scan).*no message for|Nobody publishes"):
        until(lambda: [plant.read(reading()), False][1], "it is noticed")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--silence", "scan:6"], "/scan has sent no message for"),
        (
            ["--frame", "scan:laser"],
            "cannot be used: The scans of /scan are in the frame 'laser', whose rotation in the robot is not",
        ),
    ],
)
@pytest.mark.thorough(but=1)
def test_what_is_wrong_with_a_topic_is_named(domain: int, options: list[str], text: str) -> None:
    with Peer("standin_turtlebot3.py", *options, domain=domain) as peer:
        peer.wait_event("ready")
        plant = make(domain)

        def fails() -> None:
            plant.link.open(patience_s=4.0)
            until(lambda: [plant.read(reading()), False][1], "it is noticed")

        try:
            with pytest.raises(RealtimeError, match=text):
                fails()
        finally:
            plant.close()


def test_another_node_that_commands_the_robot_is_named(robot: Peer, plant: BasePlant, domain: int) -> None:
    with (
        Peer("avoidance_node.py", domain=domain),
        pytest.raises(
            RealtimeError, match=r"Another node commands the robot: /cmd_vel by (/avoidance_node|an unnamed node)"
        ),
    ):
        until(lambda: [plant.read(reading()), False][1], "it is noticed")


def test_a_namespace_and_another_scanner(domain: int) -> None:
    plant = make(domain, namespace="tb3_1", scan_frame="laser")  # type: ignore[arg-type]
    assert [one.topic for one in plant.link.spec.inputs] == ["/tb3_1/joint_states", "/tb3_1/scan", "/tb3_1/imu"]
    assert [one.topic for one in plant.link.spec.outputs] == ["/tb3_1/cmd_vel"]
    reader = plant.link.spec.inputs[1].reader
    assert isinstance(reader, ScanReader)
    assert (reader.topic, reader.frame) == ("/tb3_1/scan", "laser")


def test_a_second_program_is_refused_and_the_first_drives_on(robot: Peer, plant: BasePlant, domain: int) -> None:
    second = make(domain)
    with pytest.raises(
        RealtimeError, match=f"Another program of this machine commands /cmd_vel in ROS domain {domain}"
    ):
        second.open()
    drive(plant, lambda: moves(robot), "the robot moves")
    plant.read(reading())


def test_two_robots_of_one_name_are_named(robot: Peer, plant: BasePlant, domain: int) -> None:
    with (
        Peer("standin_turtlebot3.py", domain=domain),
        pytest.raises(RealtimeError, match=r"Several nodes send /(joint_states|scan) at a time: .*two robots"),
    ):
        until(lambda: [plant.read(reading()), False][1], "it is noticed")


def test_a_network_with_nobody_is_named(domain: int) -> None:
    plant = make(domain)
    with pytest.raises(RealtimeError, match=r"Nobody publishes /joint_states .*No node publishes anything"):
        plant.link.open(patience_s=2.0)
    plant.close()


@pytest.mark.parametrize(
    ("options", "brain_s", "plant_s"),
    [
        ({}, 0.2, 0.5),
        ({"ros2": Ros2Config(timeout_s=0.4, silence_s=1.0)}, 0.4, 1.0),
        ({"realtime": RealtimeConfig(brain_timeout_s=20.0)}, 20.0, 0.5),
    ],
)
def test_the_brain_of_a_ros_robot_is_waited_for_as_long_as_its_commands(
    options: dict[str, Any], brain_s: float, plant_s: float
) -> None:
    realtime = TurtleBot3Config(plant="ros2", **options).realtime
    assert (realtime.brain_timeout_s, realtime.plant_timeout_s) == (brain_s, plant_s)


@pytest.mark.parametrize(("options", "latency_s"), [({}, 0.3), ({"latency_s": 0.0}, 0.0), ({"latency_s": 0.7}, 0.7)])
def test_how_late_a_base_follows_is_an_option(options: dict[str, float], latency_s: float) -> None:
    plant = make(1, **options)
    assert plant.latency_s == latency_s
    assert "/cmd_vel" in plant.hint


@pytest.mark.parametrize("options", [{"latency_s": -0.1}, {"latency_s": 3.0}, {"scan_yaw": np.nan}, {"silence_s": 0.0}])
def test_options_that_cannot_be_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(options))):
        Ros2Config(**options)  # type: ignore[arg-type]
