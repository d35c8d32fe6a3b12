"""Clients of services and actions of ROS 2 nodes.

A reply does not say which request it answers, and all clients of a service receive it. An action's goal has a UUID, by
which what its server publishes about it is recognised; see `ServiceClient` for the limits where there is none.
"""

import math
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from bhd_lerobot.errors import CommandRefusedError, ConfigError, RealtimeError, unknown_name
from bhd_lerobot.ros2.live.network import LATCHED, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.serialize import encode_one

_POLL_S = 0.002
_SETTLE_S = 0.1  # a server may find a client later than the client finds it, and does not reply before; an estimate
_RESEND_S = 1.0
_FINAL_S = 0.5  # between a reply to one of several clients and the status of its goal; an estimate
_RESULT_S = 5.0  # for the result of a goal that has ended
_ACTION = "/_action/send_goal"
_OF_EVERY_NODE = ("rcl_interfaces/", "type_description_interfaces/")  # types of services that all nodes have
# A reliable reader has the first reply of Fast DDS late or never: Cyclone DDS waits for a heartbeat of the server's
# writer, which comes up to some seconds after the match.
_RECEIVED = Qos(100, reliable=False)


class ServiceClient:
    """Calls a service.

    A reply does not say which request it answers. So that of another client that calls the service at the same moment,
    or that of an earlier call which has timed out, is taken for the reply of this one; do not call a service from two
    places where the difference matters.

    Args:
        node: the node that calls it.
        name: of the service.
        srvtype: its type, such as ``std_srvs/srv/SetBool``.

    Raises:
        ConfigError: the type is not known.
    """

    def __init__(self, node: Node, name: str, srvtype: str) -> None:
        find_type(f"{srvtype}_Request", node.network.distro)
        self.name, self.srvtype, self._node = node.full_name(name), srvtype, node
        self._requests = node.raw_publisher(f"rq{self.name}Request", f"{srvtype}_Request")
        self._replies = node.raw_subscription(f"rr{self.name}Reply", f"{srvtype}_Response", _RECEIVED)
        self._found_at = math.inf

    def call(
        self, request: Mapping[str, Any] | None = None, timeout_s: float = 5.0, *, idempotent: bool = False
    ) -> Any:
        """Send a request and return the reply, with the attributes that its type has.

        Args:
            request: values of its fields by name; what is left out is zero, empty or nothing.
            timeout_s: time to find a server and to have its reply [s].
            idempotent: whether the request may be carried out twice. Then it is sent again each second until there is
                a reply, because a server that has just started can lose it.

        Raises:
            ConfigError: the request has no such field, or the service is of another type.
            RealtimeError: there is no such service, or no reply; in the latter case the request may have been carried
                out.
        """
        return self._call(request or {}, timeout_s, idempotent=idempotent)

    def _call(
        self,
        request: Mapping[str, Any],
        timeout_s: float,
        *,
        idempotent: bool = False,
        fits: Callable[[Any, bytes], bool] = lambda reply, data: True,
    ) -> Any:
        """Send a request, and return the first reply that fits; after another one the request is sent again."""
        data = encode_one(f"{self.srvtype}_Request", request)
        end = time.monotonic() + timeout_s
        self.wait_for_server(timeout_s)
        self._replies.take()
        due = -math.inf
        while (now := time.monotonic()) < end:
            if now >= due:
                self._requests.send(data)
                due = now + _RESEND_S if idempotent else math.inf
            for received in self._replies.take():
                if fits(reply := received.message(), received.data):
                    return reply
                due = now if idempotent else due
            if not self.is_there:
                raise RealtimeError(f"The server of {self.name} has left the network without a reply.")
            time.sleep(_POLL_S)
        raise RealtimeError(
            f"The server of {self.name} has not replied within {timeout_s:g} s. The request may have been carried out."
        )

    @property
    def is_there(self) -> bool:
        """Whether a server of the service is on the network; one that was killed counts for up to 20 s more."""
        return bool(self._requests.receivers and self._replies.senders)

    def wait_for_server(self, timeout_s: float = 5.0) -> None:
        """Return when a server of the service can be called.

        Raises:
            ConfigError: it is of another type.
            RealtimeError: there is none within this time [s]; names those that are there.
        """
        _wait_for_servers((self,), timeout_s)

    def _find(self, end: float, timeout_s: float) -> None:
        while not self.is_there:
            self._found_at = math.inf
            services = self._node.graph.services()
            if services.get(self.name, self.srvtype) != self.srvtype:
                raise ConfigError(f"{self.name} is of type {services[self.name]}; the client is of {self.srvtype}.")
            if time.monotonic() > end:
                raise RealtimeError(self._absent(services, timeout_s))
            time.sleep(_POLL_S)
        self._found_at = min(self._found_at, time.monotonic())

    def _absent(self, services: Mapping[str, str], timeout_s: float) -> str:
        name, kind = self.name, "service"
        if "/_action/" in name:
            name, kind = name.partition("/_action/")[0], "action"
            there = [one.removesuffix(_ACTION) for one in services if one.endswith(_ACTION)]
        else:
            there = [
                one for one, of in services.items() if "/_action/" not in one and not of.startswith(_OF_EVERY_NODE)
            ]
        network = self._node.network
        return (
            f"{unknown_name(kind, name, there)} These are in ROS domain {network.domain_number} on "
            f"{network.interface!r}, after {timeout_s:g} s."
        )


def _wait_for_servers(services: Sequence[ServiceClient], timeout_s: float) -> None:
    end = time.monotonic() + timeout_s
    for service in services:
        service._find(end, timeout_s)
    found_at = max(service._found_at for service in services)
    time.sleep(max(0.0, found_at + _SETTLE_S - time.monotonic()))


class GoalStatus(IntEnum):
    """Where a goal is, by the numbers of ``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6

    @property
    def is_end(self) -> bool:
        """Whether the goal has ended."""
        return self >= GoalStatus.SUCCEEDED


@dataclass(frozen=True)
class GoalResult:
    """How a goal ended.

    Attributes:
        status: SUCCEEDED, CANCELED or ABORTED.
        result: the server's, with the attributes that its type has.
    """

    status: GoalStatus
    result: Any


class Goal:
    """A goal that a server has accepted; `ActionClient.send_goal` returns it.

    Attributes:
        id: its UUID, 16 bytes.
        status: where it was when the client looked last.
    """

    def __init__(self, client: "ActionClient", on_feedback: Callable[[Any], None] | None) -> None:
        self.id, self.status = uuid.uuid4().bytes, GoalStatus.UNKNOWN
        self._client, self._on_feedback = client, on_feedback
        self._server = 0  # who publishes its status
        self._dropped = False  # whether that one publishes it no more

    @property
    def _uuid(self) -> dict[str, Any]:
        return {"uuid": np.frombuffer(self.id, np.uint8)}

    def result(self, timeout_s: float = math.inf) -> GoalResult:
        """Wait for the end of the goal; meanwhile the function that takes feedback is called.

        The goal is not cancelled when the time is over. A server keeps a result for some seconds (since Iron 10 s).

        Raises:
            RealtimeError: it has not ended within this time [s], the server has left the network, or does not keep the
                result any more.
        """
        client = self._client
        client._wait(self, lambda: self.status.is_end, timeout_s, f"has not ended the goal within {timeout_s:g} s")
        before: set[bytes] = set()

        def fits(reply: Any, data: bytes) -> bool:
            """Return whether two replies were the same: that of another client's goal comes once."""
            if reply.status == self.status and data not in before:
                before.add(data)
                return False
            return reply.status in (GoalStatus.UNKNOWN, self.status)

        reply = client._get_result._call({"goal_id": self._uuid}, _RESULT_S, idempotent=True, fits=fits)
        if reply.status != self.status:
            raise RealtimeError(f"The server of {client.name} does not keep the result of the goal any more.")
        client._goals.pop(self.id, None)
        return GoalResult(self.status, reply.result)

    def cancel(self, timeout_s: float = 5.0) -> bool:
        """Ask the server to cancel the goal; return True if it does, and False if the goal had ended already.

        The goal ends later: `result` waits for that.

        Raises:
            CommandRefusedError: the server refuses.
            RealtimeError: it does not reply within this time [s], or has left the network.
        """
        client, replies = self._client, _Replies(self._client._cancel_goal)

        def is_decided() -> bool:
            mine = any(bytes(one.goal_id.uuid) == self.id for reply in replies.all() for one in reply.goals_canceling)
            return mine or self.status >= GoalStatus.CANCELING or replies.are_final()

        client._update()
        if self.status.is_end:
            return False
        replies.request({"goal_info": {"goal_id": self._uuid}})
        client._wait(self, is_decided, timeout_s, f"has not replied to the cancelling within {timeout_s:g} s")
        if self.status < GoalStatus.CANCELING and not any(reply.goals_canceling for reply in replies.all()):
            raise CommandRefusedError(f"The server of {client.name} refuses to cancel the goal.")
        return self.status not in (GoalStatus.SUCCEEDED, GoalStatus.ABORTED)


class ActionClient:
    """Sends goals to the server of an action.

    What the server publishes is matched with a goal by its UUID. Only the reply with a result has none: it is asked
    for when the goal has ended, until two replies are equal and have the goal's status. So results of other clients'
    goals are recognised, unless two that are equal arrive in these milliseconds.

    Args:
        node: the node that sends goals.
        name: of the action.
        action_type: such as ``control_msgs/action/FollowJointTrajectory``.

    Raises:
        ConfigError: the type is not known.
    """

    def __init__(self, node: Node, name: str, action_type: str) -> None:
        find_type(f"{action_type}_Goal", node.network.distro)
        self.name, self.action_type = node.full_name(name), action_type
        base = f"{self.name}/_action"
        self._send_goal = ServiceClient(node, f"{base}/send_goal", f"{action_type}_SendGoal")
        self._get_result = ServiceClient(node, f"{base}/get_result", f"{action_type}_GetResult")
        self._cancel_goal = ServiceClient(node, f"{base}/cancel_goal", "action_msgs/srv/CancelGoal")
        self._status = node.raw_subscription(f"rt{base}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
        kind = f"{action_type}_FeedbackMessage"
        self._feedback = node.raw_subscription(f"rt{base}/feedback", kind, _RECEIVED)
        self._goals: dict[bytes, Goal] = {}

    def send_goal(
        self, goal: Mapping[str, Any], on_feedback: Callable[[Any], None] | None = None, timeout_s: float = 5.0
    ) -> Goal:
        """Send a goal, and return it when the server has accepted it.

        Args:
            goal: values of its fields by name; what is left out is zero, empty or nothing.
            on_feedback: is called with each feedback, with the attributes that its type has, by the thread and during
                the calls of `Goal.result` and `Goal.cancel`.
            timeout_s: time to find a server and to have its reply [s].

        Raises:
            ConfigError: the goal has no such field, or the action is of another type.
            CommandRefusedError: the server refuses the goal.
            RealtimeError: there is no such action, or no reply; in the latter case the goal may have been accepted.
        """
        end = time.monotonic() + timeout_s
        sent, replies = Goal(self, on_feedback), _Replies(self._send_goal)
        encode_one(f"{self.action_type}_Goal", goal)
        _wait_for_servers((self._send_goal, self._get_result, self._cancel_goal), timeout_s)
        self._goals[sent.id] = sent
        replies.request({"goal_id": sent._uuid, "goal": goal})
        self._wait(
            sent,
            lambda: bool(sent.status) or replies.are_final(lambda reply: not reply.accepted),
            max(0.0, end - time.monotonic()),
            f"has not replied within {timeout_s:g} s. The goal may have been accepted",
        )
        if not sent.status:
            del self._goals[sent.id]
            raise CommandRefusedError(f"The server of {self.name} refuses the goal.")
        return sent

    def _update(self) -> None:
        """Take what has arrived about all goals."""
        for received in self._feedback.take():
            message = received.message()
            goal = self._goals.get(bytes(message.goal_id.uuid))
            if goal is not None and goal._on_feedback is not None:
                goal._on_feedback(message.feedback)
        for received in self._status.take():
            listed = {bytes(one.goal_info.goal_id.uuid): one.status for one in received.message().status_list}
            for goal in self._goals.values():
                if goal.id in listed:
                    goal.status, goal._server = GoalStatus(listed[goal.id]), received.sender
                elif goal._server == received.sender and not goal.status.is_end:
                    goal._dropped = True

    def _wait(self, goal: Goal, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Return when a condition holds for a goal.

        Raises:
            RealtimeError: it does not within this time [s], or cannot any more.
        """
        end = time.monotonic() + timeout_s
        while True:
            self._update()
            if condition():
                return
            if goal._dropped:
                raise RealtimeError(f"The server of {self.name} does not know the goal any more.")
            if not self._send_goal.is_there or (goal._server and goal._server not in self._status.sender_ids):
                raise RealtimeError(f"The server of {self.name} has left the network before the goal ended.")
            if time.monotonic() >= end:
                raise RealtimeError(f"The server of {self.name} {otherwise}.")
            time.sleep(_POLL_S)


class _Replies:
    """The replies to a request, of which that of another client may be one.

    What is known of the goal itself decides; only if nothing becomes known within a time, a reply does.
    """

    def __init__(self, service: ServiceClient) -> None:
        self._service, self._taken = service, list[tuple[float, Any]]()  # with the times of arrival [s]

    def request(self, request: Mapping[str, Any]) -> None:
        self._service._replies.take()
        self._service._requests.send(encode_one(f"{self._service.srvtype}_Request", request))

    def all(self) -> list[Any]:
        now = time.monotonic()
        self._taken += [(now, received.message()) for received in self._service._replies.take()]
        return [reply for _, reply in self._taken]

    def are_final(self, fits: Callable[[Any], bool] = lambda reply: True) -> bool:
        """Return whether one that fits has been there for that time, whatever others have come since."""
        self.all()
        return any(time.monotonic() > at + _FINAL_S and fits(reply) for at, reply in self._taken)
