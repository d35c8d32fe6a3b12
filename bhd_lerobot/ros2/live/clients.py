"""Clients of services of ROS 2 nodes; `examples/send_action.py` sends goals to actions by them."""

import math
import time
from collections.abc import Mapping
from typing import Any

from bhd_lerobot.errors import ConfigError, RealtimeError, unknown_name
from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.serialize import encode_one

_POLL_S = 0.002
_SETTLE_S = 0.1  # a server may find a client later than the client finds it, and does not reply before; an estimate
_RESEND_S = 1.0
_OF_EVERY_NODE = ("rcl_interfaces/", "type_description_interfaces/")  # types of services that all nodes have
# A reliable reader has the first reply of Fast DDS late or never: Cyclone DDS waits for a heartbeat of the server's
# writer, which comes up to some seconds after the match.
RECEIVED = Qos(100, reliable=False)


class ServiceClient:
    """Calls a service.

    A reply does not say which request it answers. So that of another client that calls the service at the same moment,
    or that of an earlier call which has timed out, is taken for the reply of this one; do not call a service from two
    places where the difference matters.

    Args:
        srvtype: its type, such as ``std_srvs/srv/SetBool``.

    Raises:
        ConfigError: the type is not known.
    """

    def __init__(self, node: Node, name: str, srvtype: str) -> None:
        find_type(f"{srvtype}_Request", node.network.distro)
        self.name, self.srvtype, self._node = node.full_name(name), srvtype, node
        self._requests = node.raw_publisher(f"rq{self.name}Request", f"{srvtype}_Request")
        self._replies = node.raw_subscription(f"rr{self.name}Reply", f"{srvtype}_Response", RECEIVED)

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
        data = encode_one(f"{self.srvtype}_Request", request or {})
        end = time.monotonic() + timeout_s
        self.wait_for_server(timeout_s)
        self._replies.take()
        due = -math.inf
        while (now := time.monotonic()) < end:
            if now >= due:
                self._requests.send(data)
                due = now + _RESEND_S if idempotent else math.inf
            for received in self._replies.take():
                return received.message()
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
        end = time.monotonic() + timeout_s
        while not self.is_there:
            services = self._node.graph.services()
            if services.get(self.name, self.srvtype) != self.srvtype:
                raise ConfigError(f"{self.name} is of type {services[self.name]}; the client is of {self.srvtype}.")
            if time.monotonic() > end:
                there = [one for one, kind in services.items() if not kind.startswith(_OF_EVERY_NODE)]
                network = self._node.network
                raise RealtimeError(
                    f"{unknown_name('service', self.name, there)} These are in ROS domain {network.domain_number} on "
                    f"{network.interface!r}, after {timeout_s:g} s."
                )
            time.sleep(_POLL_S)
        time.sleep(_SETTLE_S)
