"""What a robot on the network, by the real client library, may send our plant: it is read, or named."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.robots.base_plant import BasePlant
from tests.ros2.peer_env import Peer
from tests.waiting import until

JOINTS, SCAN = "sensor_msgs/msg/JointState", "sensor_msgs/msg/LaserScan"
WHEELS = {"name": ["wheel_left_joint", "wheel_right_joint"], "position": [1.0, 2.0], "velocity": [0.0, 0.0]}
GOOD = {"header": {"frame_id": "base_scan"}, "angle_increment": 0.5, "range_max": 3.5, "ranges": [1.0] * 12}


def make(domain: int) -> BasePlant:
    network = Ros2Config(domain=domain, silence_s=1.0)
    return BasePlant(SimpleNamespace(beams=360, imu=False, ros2=network), turtlebot3_burger())


def joints(domain: int, *options: str) -> Peer:
    return Peer("topic.py", "pub", "/joint_states", JOINTS, json.dumps(WHEELS), *options, domain=domain)


def scans(domain: int, values: str, *options: str) -> Peer:
    return Peer("topic.py", "pub", "/scan", SCAN, values, "--best-effort", *options, domain=domain)


@pytest.mark.parametrize(
    ("scan", "text"),
    [
        ({**GOOD, "ranges": []}, "/scan cannot be used: the scan has 0 ranges"),
        ({**GOOD, "angle_increment": 0.0}, "/scan cannot be used: .*angle"),
    ],
)
def test_a_scan_that_is_none_is_named(scan: dict[str, object], text: str, domain: int) -> None:
    plant = make(domain)
    with joints(domain, "--hz=20"), scans(domain, json.dumps(scan)), pytest.raises(RealtimeError, match=text):
        plant.link.open(patience_s=4.0)
    plant.close()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("/joint_states", JOINTS, "{}", "--best-effort"), "/topic_pub is best effort; the subscription here is reliable"),
        (("/joint_states", "std_msgs/msg/String"), f"/topic_pub is of type std_msgs/msg/String; .* of {JOINTS}"),
        (("/joint_states", JOINTS), "/joint_states cannot be used: it has positions and velocities of no joint; needed"),
    ],
)
@pytest.mark.thorough(but=1)
def test_a_topic_that_does_not_fit_is_named(options: tuple[str, ...], text: str, domain: int) -> None:
    plant = make(domain)
    with Peer("topic.py", "pub", *options, domain=domain), pytest.raises(RealtimeError, match=text):
        plant.link.open(patience_s=4.0)
    plant.close()


def test_a_flood_and_a_scan_of_an_absurd_size_are_read(domain: int, tmp_path: Path) -> None:
    beams = 500_000
    large = tmp_path / "scan"
    large.write_text(json.dumps({**GOOD, "angle_increment": 2 * np.pi / beams, "ranges": [1.5] * beams}))
    plant, out = make(domain), PlantReading(1, 2, 360)
    with joints(domain, "--hz=1000", "--burst=10"), scans(domain, f"@{large}", "--hz=2"):
        plant.link.open(patience_s=30.0)
        plant.read(out)
        np.testing.assert_array_equal(out.position, [[1.0, 2.0]])
        np.testing.assert_allclose(out.sensors, 1.5)
        count = plant.state()["count"][0]
        until(lambda: plant.state()["count"][0] > count + 1000, "a thousand more joint states")
    plant.close()


@pytest.mark.parametrize("fault", ["--zero-stamp=all", "--clock-offset=86400"])
def test_stamps_of_zero_and_of_tomorrow_are_of_another_clock(fault: str, domain: int) -> None:
    plant, out = make(domain), PlantReading(1, 2, 360)
    out.stamp_ns = np.zeros(1, np.int64)
    with Peer("standin_turtlebot3.py", fault, domain=domain):
        plant.open()
        before = int(plant.state()["count"][0])
        until(lambda: plant.state()["count"][0] > before + 5, "five more joint states")
        plant.read(out)
        assert 0 < plant.state()["arrived_ns"][0] - out.stamp_ns[0] + 1 < 1e9
    plant.close()


def test_wheels_that_are_not_a_number_are_read_as_they_are(domain: int) -> None:
    """The check of all readings above the plants finds them."""
    plant, out = make(domain), PlantReading(1, 2, 360)
    with Peer("standin_turtlebot3.py", "--nan=joint_states:0:999", "--nan=scan:0:999", domain=domain):
        plant.open()
        plant.read(out)
        assert np.isnan(out.position).all()
        np.testing.assert_array_equal(out.sensors, 3.5)  # a reading that is none is no return
    plant.close()
