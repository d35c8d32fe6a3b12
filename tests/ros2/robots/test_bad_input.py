"""What a robot on the network, by the real client library, may send our plant: it is read, or named."""

import contextlib
import json
import re
from collections.abc import Iterator
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
GOOD = {
    "header": {"frame_id": "base_scan"},
    "angle_increment": 2 * np.pi / 360,
    "range_max": 3.5,
    "ranges": [1.0] * 360,
}


@pytest.fixture
def plant(domain: int) -> Iterator[BasePlant]:
    network = Ros2Config(domain=domain, silence_s=1.0)
    made = BasePlant(SimpleNamespace(beams=360, imu=False, ros2=network), turtlebot3_burger())
    yield made
    made.close()


def refused(plant: BasePlant, *peers: Peer) -> str:
    """Return why the plant cannot be opened while the peers publish."""
    with contextlib.ExitStack() as stack:
        for peer in peers:
            stack.enter_context(peer).wait_event("ready")
        with pytest.raises(RealtimeError) as caught:
            plant.link.open(patience_s=4.0)
    return str(caught.value)


def joints(domain: int, *options: str) -> Peer:
    return Peer("topic.py", "pub", "/joint_states", JOINTS, json.dumps(WHEELS), *options, domain=domain)


def scans(domain: int, values: str, *options: str) -> Peer:
    return Peer("topic.py", "pub", "/scan", SCAN, values, "--best-effort", *options, domain=domain)


@pytest.mark.parametrize(
    ("scan", "text"),
    [
        ({**GOOD, "ranges": []}, "/scan cannot be used: the scan has 0 ranges"),
        ({**GOOD, "angle_increment": 0.0}, "/scan cannot be used: .*angle"),
        (
            {**GOOD, "ranges": [1.0] * 100_000},
            "/scan cannot be used: the scan has 100000 ranges; at most 10000 are read",
        ),
    ],
)
@pytest.mark.thorough(but=1)
def test_a_scan_that_is_none_is_named(
    scan: dict[str, object], text: str, plant: BasePlant, domain: int, tmp_path: Path
) -> None:
    values = tmp_path / "scan"
    values.write_text(json.dumps(scan))
    assert re.search(text, refused(plant, joints(domain, "--hz=20"), scans(domain, f"@{values}")))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("/joint_states", "std_msgs/msg/String"), f"/topic_pub is of type std_msgs/msg/String; .* of {JOINTS}"),
        (
            ("/joint_states", JOINTS),
            "/joint_states cannot be used: it has positions and velocities of no joint; needed",
        ),
    ],
)
@pytest.mark.thorough(but=1)
def test_a_topic_that_does_not_fit_is_named(options: tuple[str, ...], text: str, plant: BasePlant, domain: int) -> None:
    assert re.search(text, refused(plant, Peer("topic.py", "pub", *options, domain=domain)))


def test_a_flood_is_read(plant: BasePlant, domain: int) -> None:
    out = PlantReading(1, 2, 360)
    driver = Peer("topic.py", "echo", "/cmd_vel", "geometry_msgs/msg/TwistStamped", domain=domain)
    with driver, joints(domain, "--hz=1000", "--burst=10"), scans(domain, json.dumps(GOOD)):
        plant.link.open(patience_s=30.0)
        plant.read(out)
        np.testing.assert_array_equal(out.position, [[1.0, 2.0]])
        count = plant.state()["count"][0]
        until(lambda: plant.state()["count"][0] > count + 1000, "a thousand more joint states")


@pytest.mark.parametrize("fault", ["--zero-stamp=all", "--clock-offset=86400"])
def test_stamps_of_zero_and_of_tomorrow_are_of_another_clock(fault: str, plant: BasePlant, domain: int) -> None:
    out = PlantReading(1, 2, 360)
    out.stamp_ns = np.zeros(1, np.int64)
    with Peer("standin_turtlebot3.py", fault, domain=domain):
        plant.open()
        before = int(plant.state()["count"][0])
        until(lambda: plant.state()["count"][0] > before + 5, "five more joint states")
        plant.read(out)
        assert 0 < plant.state()["arrived_ns"][0] - out.stamp_ns[0] + 1 < 1e9


def test_wheels_that_are_not_a_number_are_read_as_they_are(plant: BasePlant, domain: int) -> None:
    """The check of all readings above the plants finds them."""
    out = PlantReading(1, 2, 360)
    with Peer("standin_turtlebot3.py", "--nan=joint_states:0:999", "--nan=scan:0:999", domain=domain):
        plant.open()
        plant.read(out)
        assert np.isnan(out.position).all()
        np.testing.assert_array_equal(out.sensors, 3.5)  # a reading that is none is no return
