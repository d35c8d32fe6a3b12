"""Definitions of types from the nodes that use them: since Jazzy each node has a service for it."""

from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.ros2.live.clients import ServiceClient
from bhd_lerobot.ros2.live.graph import Endpoint
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import find_type, register_unknown

_SERVICE = "type_description_interfaces/srv/GetTypeDescription"
_ANSWER_S = 3.0


def find_type_of(node: Node, endpoint: Endpoint, timeout_s: float = _ANSWER_S) -> None:
    """Make sure that the definition of an endpoint's type is known; its node is asked for one that is not.

    Raises:
        ConfigError: it is not, and the node does not state it.
    """
    try:
        find_type(endpoint.msgtype, node.network.distro)
    except ConfigError as error:
        if not endpoint.node or not endpoint.type_hash:
            raise
        try:
            _ask(node, endpoint, timeout_s)
            find_type(endpoint.msgtype, node.network.distro)
        except BhdError as why:
            raise ConfigError(f"{error} Its node {endpoint.node} does not state it either: {why}") from why


def _ask(node: Node, endpoint: Endpoint, timeout_s: float) -> None:
    client = ServiceClient(node, f"{endpoint.node}/get_type_description", _SERVICE)
    request = {
        "type_name": endpoint.msgtype, "type_hash": endpoint.type_hash, "include_type_sources": True,
    }  # fmt: skip
    reply = client.call(request, timeout_s, idempotent=True)
    if not reply.successful:
        raise ConfigError(reply.failure_reason or "it gives no reason.")
    register_unknown({one.type_name: one.raw_file_contents for one in reply.type_sources if one.encoding == "msg"})
