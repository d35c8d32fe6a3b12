"""Setpoints of another node."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.errors import BrainStoppedError, ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.topic.brain import TopicBrain
from bhd_lerobot.policies.topic.config import TopicConfig
from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.mapping import FieldConfig, topics_of
from tests.ros2.peer_env import free_domain
from tests.waiting import until

STAMPED = "geometry_msgs/msg/TwistStamped"
NOTHING = Observation((), np.zeros((1, 0)))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setattr("bhd_lerobot.policies.topic.brain._DISCOVERY_S", 0.0)
    with free_domain() as domain, Node("other", NetworkConfig(domain)) as made:
        yield made


def features(body: Any, *actions: str) -> RobotFeatures:
    return RobotFeatures("robot", actions, (), 10, body=body)


@contextmanager
def begun(config: TopicConfig, robot: RobotFeatures) -> Iterator[TopicBrain]:
    with closing(TopicBrain(config)) as brain:
        brain.bind(robot)
        brain.reset(np.zeros(1, np.intp), [0], 1)
        yield brain


def act(brain: TopicBrain, send: Callable[[], None], wanted: Callable[[Any], Any]) -> Any:
    """Send until the brain's action is as wanted, and return it."""

    def step() -> Any:
        send()
        action = brain.act(NOTHING)
        return [action] if wanted(action) else None

    return until(step, "the action comes")[0]


def test_a_base_is_driven_by_twists_and_by_none_that_is_old(node: Node) -> None:
    x, turn = (FieldConfig("t", STAMPED, f"twist.{field}") for field in ("linear.x", "angular.z"))
    [twist] = topics_of({"x": x, "turn": turn}, {})
    publisher = node.publisher("/brain/cmd_vel", STAMPED)
    config = TopicConfig(network=node.network, command_timeout_s=0.3, timeout_s=2.0)
    with begun(config, features(turtlebot3_burger(), "x.vel", "theta.vel")) as brain:
        action = act(
            brain,
            lambda: publisher.send(twist.encode(np.array([0.1, -0.2]), time.time_ns())),
            lambda found: found is not None,
        )
        assert action.tolist() == [[0.1, -0.2]]
        until(lambda: brain.act(NOTHING) is None, "the setpoint is too old")
        with pytest.raises(BrainStoppedError, match=r"no setpoint for 2\.\d s: /brain/cmd_vel has sent no message"):
            until(lambda: [brain.act(NOTHING), False][1], "the episode ends")


def test_what_is_not_finite_ends_the_episode(node: Node) -> None:
    [twist] = topics_of({"x": FieldConfig("t", STAMPED, "twist.linear.x")}, {})
    publisher = node.publisher("/brain/cmd_vel", STAMPED)
    with (
        begun(TopicConfig(network=node.network), features(turtlebot3_burger(), "x.vel", "theta.vel")) as brain,
        pytest.raises(BrainStoppedError, match="not finite"),
    ):
        act(brain, lambda: publisher.send(twist.encode(np.array([np.nan]), 0)), lambda _: False)


def test_another_robot_is_driven_by_numbers_in_order_or_by_a_mapping(node: Node, tmp_path: Path) -> None:
    kind = "std_msgs/msg/Float64MultiArray"
    [floats] = topics_of({str(k): FieldConfig("t", kind, f"data[{k}]") for k in range(2)}, {})
    publisher = node.publisher("/brain/commands", kind)
    mapping = tmp_path / "map.yaml"
    entry = f"{{topic: /brain/commands, type: {kind}, field: 'data[%d]'}}"
    mapping.write_text(f"action:\n  b.pos: {entry % 0}\n  a.pos: {entry % 1}\n")
    for path, expected in (("", [[1.0, 2.0]]), (str(mapping), [[2.0, 1.0]])):
        with begun(TopicConfig(path, node.network), features(None, "a.pos", "b.pos")) as brain:
            send = lambda: publisher.send(floats.encode(np.array([1.0, 2.0]), 0))  # noqa: E731
            assert act(brain, send, lambda found: found is not None).tolist() == expected


def test_of_an_arm_on_a_base_twists_drive_the_base_and_numbers_the_arm(node: Node) -> None:
    body = turtlebot3_manipulation()
    names, speeds = body.limits.names, body.need(Drive).limits.names
    with begun(TopicConfig(network=node.network), features(body, *names)) as brain:
        assert [[names[column] for column in columns] for columns in brain._columns] == [
            list(speeds),
            [name for name in names if name not in speeds],
        ]


@pytest.mark.law
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("action:\n  x.vel: {topic: a, type: std_msgs/msg/Float64, field: data}\n", "has no action theta.vel"),
        ("action:\n  y.vel: {topic: a, type: std_msgs/msg/Float64, field: data}\n", "Did you mean 'x.vel'"),
    ],
)
def test_a_mapping_of_other_actions_is_refused(tmp_path: Path, text: str, message: str) -> None:
    mapping = tmp_path / "map.yaml"
    mapping.write_text(text)
    brain = TopicBrain(TopicConfig(str(mapping)))
    with pytest.raises(ConfigError, match=message):
        brain.bind(features(turtlebot3_burger(), "x.vel", "theta.vel"))
