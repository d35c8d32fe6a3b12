"""A stand-in for the UR driver, by rclpy, below our plant: what it reads, and what the driver's stops become."""

import signal
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.plant import PlantReading, SafetyStatus
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.robots.arm_plant import ArmPlant
from tests.cases import each_case
from tests.ros2.feed import JOINTS, Sent, feed, head
from tests.ros2.peer_env import Peer, environment
from tests.waiting import until

SAFETY = (ur.SAFETY_TOPIC, ur.SAFETY_MODE, {"mode": np.array([3])})
STOPS = {
    "scaling:0": SafetyStatus.STOPPED,
    "scaling:100": SafetyStatus.NORMAL,
    "safety:3": SafetyStatus.STOPPED,
    "safety:7": SafetyStatus.EMERGENCY_STOP,
    "safety:9": SafetyStatus.FAULT,
}


@pytest.fixture
def plant(domain: int) -> Iterator[ArmPlant]:
    with closing(ArmPlant(SimpleNamespace(ros2=Ros2Config(domain=domain, silence_s=1.0)), ur5())) as made:
        yield made


def reading() -> PlantReading:
    return PlantReading(1, 7)


def test_it_reads_and_moves_the_joints_and_names_what_the_driver_does(plant: ArmPlant, domain: int) -> None:
    environment(messages=True)
    target = np.array([[0.1, -1.4, 1.5, -1.6, -1.5, 0.2, 0.05]])
    out = reading()
    with Peer("ur_driver_standin.py", *(f"--on-usr1={one}" for one in (*STOPS, "silence")), domain=domain) as robot:
        robot.wait_event("ready")
        plant.open()
        plant.enable()
        plant.read(out)
        shown = robot.wait(lambda line: "position" in line)["position"]
        np.testing.assert_allclose(out.position[0, :6], shown, atol=1e-3)

        def arrives() -> bool:
            plant.write(target)
            plant.read(out)
            return bool(np.abs(out.position - target).max() < 1e-3)

        until(arrives, "the arm is where it was sent")
        there = pytest.approx(target[0, :6].tolist(), abs=1e-3)
        robot.wait(lambda line: line.get("position") == there, "that it is there")
        assert out.safety[0] == SafetyStatus.NORMAL
        for what, status in STOPS.items():
            robot.signal(signal.SIGUSR1)
            until(lambda status=status: [plant.read(out), out.safety[0] == status][1], f"{what} is {status.name}")
        robot.signal(signal.SIGUSR1)
        with pytest.raises(RealtimeError, match=r"/joint_states has sent no message for \d+\.\d\d s"):
            until(lambda: [plant.read(reading()), False][1], "its silence is noticed")
        # The same words by whoever notices it: the control loop, or the node.
        told = "/joint_states has sent no message for "
        until(lambda: plant.link.problem.startswith(told), "the node notices it, too")


@pytest.mark.parametrize("latched", [True, False])
def test_the_safety_mode_is_read_of_drivers_that_keep_it_and_of_those_that_do_not(plant, domain, latched):
    """`ur_robot_driver` publishes it volatile before 2024; a node that receives no gripper's commands is no problem."""
    joints = [f"{joint}_joint" for joint in ur5().arm.chain.joints]
    out = reading()

    def make(at: float) -> list[Sent]:
        angles = {"name": joints, "position": np.zeros((1, 6)), "velocity": np.zeros((1, 6))}
        return [("/joint_states", JOINTS, {"header": head(), **angles})] + [SAFETY] * (not latched and at > 3)

    kept = ((ur.SAFETY_TOPIC, ur.SAFETY_MODE, SAFETY[2]),) if latched else ()
    with feed(domain, make, hz=125, receives=((ur.POSITION_TOPIC, ur.FLOATS),), kept=kept):
        plant.open()
        until(lambda: [plant.read(out), out.safety[0] == SafetyStatus.STOPPED][1], "the stop is noticed")


def test_an_arm_without_a_gripper_is_read_and_commanded(domain: int) -> None:
    body = replace(ur5(), arm=replace(ur5().need(Arm), gripper=None))
    plant: Any = ArmPlant(SimpleNamespace(ros2=Ros2Config(domain=domain)), body)
    assert [one.topic for one in plant.link.spec.outputs] == [ur.POSITION_TOPIC]
    sent: list[np.ndarray] = []
    plant.link = SimpleNamespace(write=sent.append)
    plant.enable()
    plant.write(np.arange(6.0)[None])
    assert [values.tolist() for values in sent] == [list(range(6))]
    out = PlantReading(1, 6)
    plant.read_parts({"values": np.append(np.arange(12.0), [100.0, 1.0]), "measured_ns": np.zeros(3)}, out)
    assert out.position.tolist() == [list(range(6))]
    assert out.velocity.tolist() == [list(range(6, 12))]


@each_case("option", [{"scan_yaw": 0.1}, {"wheel_speeds": "rad/s"}])
def test_an_option_of_a_base_is_refused(option: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"robot.ros2.{next(iter(option))} is .*; an arm has no"):
        ArmPlant(SimpleNamespace(ros2=Ros2Config(**option)), ur5())
