import json
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.ros2.live.clients import ServiceClient
from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import DEFINITIONS, find_type, register_types
from bhd_lerobot.ros2.messages.types import type_store
from tests.docs.support import load_script
from tests.ros2.peer_env import Peer, environment, free_domain

SET_BOOL, TRIGGER, FIBONACCI = "std_srvs/srv/SetBool", "std_srvs/srv/Trigger", "test_msgs/action/Fibonacci"
example = load_script("send_action", "examples")
NUMBERS = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89]


@pytest.fixture(autouse=True)
def types() -> None:
    register_types({FIBONACCI: "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"})


@pytest.fixture(scope="module")
def shared() -> Iterator[int]:
    """The domain of the servers of most tests."""
    with free_domain() as domain:
        yield domain


@pytest.fixture(scope="module")
def servers(shared: int) -> Iterator[Peer]:
    with Peer("servers.py", domain=shared) as peer:
        peer.wait_event("ready")
        yield peer


@pytest.fixture
def node(shared: int) -> Iterator[Node]:
    with Node("client", NetworkConfig(domain=shared)) as node:
        yield node


@pytest.fixture
def other(domain: int) -> Iterator[Node]:
    """A node in a domain of the test's own."""
    with Node("client", NetworkConfig(domain=domain)) as node:
        yield node


def test_definitions_are_those_of_ros() -> None:
    """By the hashes that ROS computes of its own."""
    share = environment().python.parents[1] / "share"
    compared = 0
    for name in (*DEFINITIONS, FIBONACCI):
        package, kind, short = name.split("/")
        file = share / package / kind / f"{short}.json"
        if not file.exists():
            continue
        find_type(name)
        for one in json.loads(file.read_text())["type_hashes"]:
            if one["type_name"] in type_store().fielddefs:
                assert type_store().hash_rihs01(one["type_name"]) == one["hash_string"], one["type_name"]
                compared += one["type_name"].startswith(name)
    assert compared >= 4 * 2 + 8  # four services and an action at least, of what the wheels have


def test_every_request_to_a_service_has_its_reply_and_is_carried_out_once(shared: int, servers: Peer) -> None:
    before = len(servers.events("motor_power"))
    for calls in range(1, 4):  # a client that comes later has its first reply as well
        with Node("client", NetworkConfig(domain=shared)) as node:
            motors, odometry = (
                ServiceClient(node, "/motor_power", SET_BOOL),
                ServiceClient(node, "reset_odometry", TRIGGER),
            )
            for on in (True, False):
                reply = motors.call({"data": on}, 60)
                assert (reply.success, reply.message) == (True, f"motor power is {'on' if on else 'off'}")
            assert odometry.call(timeout_s=60).message == str(calls)
    assert [line["data"] for line in servers.events("motor_power")[before:]] == 3 * [True, False]


def test_what_cannot_be_called_is_named(node: Node, servers: Peer) -> None:
    before = len(servers.events("motor_power"))
    ServiceClient(node, "/motor_power", SET_BOOL).wait_for_server(60)
    for call, kind, said in (
        (lambda: ServiceClient(node, "/motor_powr", SET_BOOL).call(timeout_s=0.1), RealtimeError, "'/motor_power'?"),
        (lambda: ServiceClient(node, "/x", SET_BOOL).call(timeout_s=0.1), RealtimeError, "/motor_power, /reset"),
        (lambda: ServiceClient(node, "/reset_odometry", SET_BOOL).call(), ConfigError, f"{TRIGGER}; the client is of"),
        (lambda: ServiceClient(node, "/motor_power", "std_srvs/srv/SetBol"), ConfigError, "'std_srvs/srv/SetBool'"),
        (lambda: ServiceClient(node, "/motor_power", SET_BOOL).call({"dat": True}), ConfigError, "'data'?"),
        (lambda: ServiceClient(node, "/motor_power", SET_BOOL).call({"data": 1}), ConfigError, "is 1; it is true or"),
    ):
        with pytest.raises(kind) as found:
            call()
        assert said in str(found.value)
    assert len(servers.events("motor_power")) == before


def test_no_reply_in_time_is_an_error_and_an_idempotent_request_is_sent_again(domain: int, other: Node) -> None:
    with Peer("servers.py", "--busy", 2, domain=domain) as peer:
        client = ServiceClient(other, "/motor_power", SET_BOOL)
        client.wait_for_server(60)
        with pytest.raises(RealtimeError, match=r"has not replied within 0.3 s. The request may have been carried out"):
            client.call({"data": True}, 0.3)
        assert client.call({"data": True}, 60, idempotent=True).success
        peer.wait(lambda _: len(peer.events("motor_power")) >= 3, "three requests")


def test_the_example_follows_a_goal_to_its_end(node: Node, servers: Peer, capsys: pytest.CaptureFixture[str]) -> None:
    def send(order: int, on_feedback: Callable[[Any], None] = lambda _: None) -> Any:
        return example.send_goal(node, "/fibonacci", FIBONACCI, {"order": order}, on_feedback, timeout_s=60)

    def interrupt(_: Any) -> None:
        interrupts.append(1)
        if len(interrupts) == 1:
            raise KeyboardInterrupt

    feedback: list[Any] = []
    ended, result = send(12, feedback.append)
    assert (ended, result.sequence.tolist()) == ("succeeded", NUMBERS)
    assert len(feedback) > 1
    for one in feedback:
        np.testing.assert_array_equal(one.sequence, NUMBERS[: len(one.sequence)])
    assert send(0) == ("refused", None)
    assert send(120)[0] == "aborted"
    for order, how, said in ((50, "canceled", ""), (60, "succeeded", "refuses to cancel")):
        interrupts: list[int] = []
        assert send(order, interrupt)[0] == how
        assert said in capsys.readouterr().out
    assert [line["succeeded"] for line in servers.events("ended") if line["order"] >= 50] == [False, False, True]


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_server_that_leaves_during_a_goal_is_an_error(domain: int, other: Node, how: signal.Signals) -> None:
    left = pytest.raises(RealtimeError, match="/fibonacci has left the network before the goal ended")
    with Peer("servers.py", "--step", 0.5, domain=domain) as peer, left:
        example.send_goal(other, "/fibonacci", FIBONACCI, {"order": 40}, lambda _: peer.signal(how), timeout_s=60)
