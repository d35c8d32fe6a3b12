"""A stand-in for the UR driver, by rclpy, below our plant: what it reads, and what the driver's stops become."""

import signal
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.plant import PlantReading, SafetyStatus
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.robots.arm_plant import ArmPlant
from tests.ros2.feed import JOINTS, Sent, feed, head
from tests.ros2.peer_env import Peer, environment
from tests.waiting import until

SAFETY = (ur.SAFETY_TOPIC, ur.SAFETY_MODE, {"mode": np.array([3])})
ACTIVE = ("ur_driver_standin.py", "--active=forward_position_controller")


@pytest.fixture
def plant(domain: int) -> Iterator[ArmPlant]:
    made = ArmPlant(SimpleNamespace(ros2=Ros2Config(domain=domain, silence_s=1.0)), ur5())
    try:
        yield made
    finally:
        made.close()


def reading() -> PlantReading:
    return PlantReading(1, 7)


def test_it_reads_the_joints_by_their_names_and_moves_them(plant: ArmPlant, domain: int) -> None:
    target = np.array([[0.1, -1.4, 1.5, -1.6, -1.5, 0.2, 0.05]])
    out = reading()
    with Peer(*ACTIVE, domain=domain) as robot:
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
        robot.wait(
            lambda line: line.get("position") == pytest.approx(target[0, :6].tolist(), abs=1e-3), "that it is there"
        )
        assert out.safety[0] == SafetyStatus.NORMAL


@pytest.mark.parametrize(
    ("options", "status"),
    [
        (("--on-usr1=safety", "--value=3"), SafetyStatus.STOPPED),
        (("--on-usr1=safety", "--value=7"), SafetyStatus.EMERGENCY_STOP),
        (("--on-usr1=safety", "--value=9"), SafetyStatus.FAULT),
        (("--on-usr1=scaling", "--value=0"), SafetyStatus.STOPPED),
    ],
)
@pytest.mark.thorough(but=2)
def test_a_stop_of_the_driver_is_a_safety_status(
    options: tuple[str, ...], status: SafetyStatus, plant: ArmPlant, domain: int
) -> None:
    environment(messages=True)
    out = reading()
    with Peer(*ACTIVE, *options, domain=domain) as robot:
        robot.wait_event("ready")
        plant.open()
        plant.read(out)
        assert out.safety[0] == SafetyStatus.NORMAL
        robot.signal(signal.SIGUSR1)
        until(lambda: [plant.read(out), out.safety[0] == status][1], f"its status is {status.name}")


def test_a_driver_that_is_silent_is_named(plant: ArmPlant, domain: int) -> None:
    with Peer(*ACTIVE, "--on-usr1=silence", domain=domain) as robot:
        robot.wait_event("ready")
        plant.open()
        robot.signal(signal.SIGUSR1)
        with pytest.raises(RealtimeError, match=r"/joint_states has .*no message"):
            until(lambda: [plant.read(reading()), False][1], "it is noticed")


@pytest.mark.parametrize("latched", [True, False])
def test_the_safety_mode_is_read_of_drivers_that_keep_it_and_of_those_that_do_not(
    plant: ArmPlant, domain: int, latched: bool
) -> None:
    """`ur_robot_driver` publishes it volatile before 2024; a node that receives no gripper's commands is no problem."""
    joints = [f"{joint}_joint" for joint in ur5().chain.joints]
    out = reading()

    def make(at: float) -> list[Sent]:
        angles = {"name": joints, "position": np.zeros((1, 6)), "velocity": np.zeros((1, 6))}
        return [("/joint_states", JOINTS, {"header": head(), **angles})] + [SAFETY] * (not latched and at > 3)

    kept = ((ur.SAFETY_TOPIC, ur.SAFETY_MODE, SAFETY[2]),) if latched else ()
    with feed(domain, make, hz=125, receives=((ur.POSITION_TOPIC, ur.FLOATS),), kept=kept):
        plant.open()
        until(lambda: [plant.read(out), out.safety[0] == SafetyStatus.STOPPED][1], "the stop is noticed")


def test_a_driver_without_the_position_controller_is_named(plant: ArmPlant, domain: int) -> None:
    joints = [f"{joint}_joint" for joint in ur5().chain.joints]
    angles = {"name": joints, "position": np.zeros((1, 6)), "velocity": np.zeros((1, 6))}
    receives = ((ur.TRAJECTORY_TOPIC, ur.TRAJECTORY),)
    with (
        feed(domain, lambda _: [("/joint_states", JOINTS, {"header": head(), **angles})], hz=125, receives=receives),
        pytest.raises(RealtimeError, match="No node receives /forward_position_controller/commands"),
    ):
        plant.open()
