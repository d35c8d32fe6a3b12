"""What other nodes, by the real client library, may send a served robot: it is refused or named, and it serves on."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ros2.peer_env import Peer, environment
from tests.ros2.programs import Served
from tests.waiting import until

STAMPED, TWIST = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
COMMAND, RESULT = (f"bhd_interfaces/msg/{name}" for name in ("BrainCommand", "BrainResult"))
FORWARD = {"linear": {"x": 0.1}}
LATER = {"stamp": {"sec": 2_000_000_000}}


def moves(line: dict[str, Any]) -> bool:
    return "message" in line and abs(line["message"]["twist"]["twist"]["linear"]["x"]) > 0.05


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    from tests.ros2.peer_env import free_domain

    environment(messages=True)
    folder = tmp_path_factory.mktemp("served")
    with (
        free_domain() as domain,
        Served("turtlebot3", "--robot.arena=empty", domain=domain, log=folder / "log") as robot,
    ):
        robot.domain = domain
        yield robot


@pytest.mark.parametrize("header", [{"stamp": {"sec": 0}}, LATER], ids=["zero", "tomorrow"])
@pytest.mark.thorough(but=1)
def test_commands_with_wrong_stamps_are_taken_as_a_real_robot_does(header: dict[str, Any], base: Served) -> None:
    values = json.dumps({"header": header, "twist": FORWARD})
    with (
        Peer("topic.py", "echo", "/odom", "nav_msgs/msg/Odometry", domain=base.domain) as echo,
        Peer("topic.py", "pub", "/cmd_vel", STAMPED, values, domain=base.domain),
    ):
        echo.wait(moves, "the robot moves")


def test_a_twist_that_is_not_finite_is_refused(base: Served) -> None:
    values = json.dumps({"twist": {"linear": {"x": math.nan}}})
    with (
        Peer("topic.py", "echo", "/odom", "nav_msgs/msg/Odometry", domain=base.domain) as echo,
        Peer("topic.py", "pub", "/cmd_vel", STAMPED, values, domain=base.domain),
    ):
        base.wait_for("/cmd_vel: the command holds NaN or an infinity")
        stands(echo)
        before = len(echo.lines)
        until(lambda: len(echo.lines) > before + 20, "20 messages of /odom")
        assert not any(moves(line) for line in echo.lines[before:])


def stands(echo: Peer) -> None:
    """Wait until the robot stands: a test before this one may have driven it."""
    until(lambda: echo.lines and "message" in echo.lines[-1] and not moves(echo.lines[-1]), "the robot stands")


def test_a_flood_of_commands_is_followed_and_the_robot_still_answers(base: Served) -> None:
    flood = ("/cmd_vel", STAMPED, json.dumps({"twist": FORWARD}), "--hz=1000", "--burst=10")
    with (
        Peer("topic.py", "pub", *flood, domain=base.domain),
        Peer("topic.py", "echo", "/odom", "nav_msgs/msg/Odometry", domain=base.domain) as echo,
    ):
        echo.wait(moves, "the robot moves")
        before = len(echo.events("message"))
        until(lambda: len(echo.events("message")) > before + 20, "20 more messages of /odom")


def test_a_command_of_an_absurd_size_gets_its_result_and_others_theirs(base: Served, tmp_path: Path) -> None:
    values = tmp_path / "values"
    values.write_text(json.dumps({"task_id": "a" * 10_000_000, "target_pose": {"orientation": {"w": 0.0}}}))
    for text, name in ((f"@{values}", "a" * 10_000_000), ('{"task_id": "small"}', "small")):
        with (
            Peer("topic.py", "echo", "/brain/result", RESULT, domain=base.domain) as echo,
            Peer("topic.py", "pub", "/brain/command", COMMAND, text, "--hz=1", domain=base.domain),
        ):
            message = echo.wait_event("message")["message"]
        assert message["task_id"] == name


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (("pub", "/cmd_vel", TWIST), f"The publisher of /cmd_vel in /topic_pub is of type {TWIST}"),
        (("pub", "/cmd_vel", STAMPED, "--best-effort"), "The publisher of /cmd_vel in /topic_pub is best effort"),
        (("echo", "/scan", "sensor_msgs/msg/LaserScan"), "The subscription of /scan in /topic_echo is reliable"),
    ],
)
@pytest.mark.thorough(but=1)
def test_a_node_whose_topic_does_not_fit_is_named(command: tuple[str, ...], text: str, base: Served) -> None:
    with Peer("topic.py", *command, domain=base.domain):
        base.wait_for(text)
