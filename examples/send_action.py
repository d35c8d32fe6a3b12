"""Send a goal to an action of a ROS 2 network; print its feedback, how it ended and its result. Ctrl-C cancels it.

    python examples/send_action.py /navigate_to_pose nav2_msgs/action/NavigateToPose \
        '{pose: {header: {frame_id: map}, pose: {position: {x: 1.0}, orientation: {w: 1.0}}}}' --interface=wlan0

What the server publishes is matched with the goal by its UUID. Replies have none: while another client sends goals to
the same server, a reply may be that to the other one.
"""

import argparse
import sys
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from bhd_lerobot.errors import BhdError, RealtimeError
from bhd_lerobot.ros2.live.clients import RECEIVED, ServiceClient
from bhd_lerobot.ros2.live.network import LATCHED, NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.live.topics import plain

ENDED = {4: "succeeded", 5: "canceled", 6: "aborted"}  # action_msgs/msg/GoalStatus


def send_goal(
    node: Node,
    name: str,
    kind: str,
    goal: Mapping[str, Any],
    on_feedback: Callable[[Any], None],
    *,
    timeout_s: float = 5.0,
) -> tuple[str, Any]:
    """Send a goal and wait for its end; return how it ended, and the server's result, None of a goal it refuses.

    A KeyboardInterrupt, also of `on_feedback`, asks the server to cancel the goal.
    """
    base = f"{node.full_name(name)}/_action"
    send = ServiceClient(node, f"{base}/send_goal", f"{kind}_SendGoal")
    cancel = ServiceClient(node, f"{base}/cancel_goal", "action_msgs/srv/CancelGoal")
    get_result = ServiceClient(node, f"{base}/get_result", f"{kind}_GetResult")
    status = node.raw_subscription(f"rt{base}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
    feedback = node.raw_subscription(f"rt{base}/feedback", f"{kind}_FeedbackMessage", RECEIVED)
    number = uuid.uuid4().bytes
    goal_id = {"uuid": np.frombuffer(number, np.uint8)}
    if not send.call({"goal_id": goal_id, "goal": goal}, timeout_s).accepted:
        return "refused", None
    ended = ""
    while not ended:
        try:
            for message in (received.message() for received in feedback.take()):
                if bytes(message.goal_id.uuid) == number:
                    on_feedback(message.feedback)
            for message in (received.message() for received in status.take()):
                for one in message.status_list:
                    if bytes(one.goal_info.goal_id.uuid) == number:
                        ended = ENDED.get(one.status, "")
            if not send.is_there:
                raise RealtimeError(f"The server of {name} has left the network before the goal ended.")
            time.sleep(0.005)
        except KeyboardInterrupt:
            if not cancel.call({"goal_info": {"goal_id": goal_id}}, timeout_s).goals_canceling:
                print("The server refuses to cancel the goal.")
    return ended, get_result.call({"goal_id": goal_id}, timeout_s, idempotent=True).result


def main(arguments: Sequence[str] | None = None) -> int:
    """Send the goal; return 0 if it succeeded, 1 otherwise, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="of the action")
    parser.add_argument("type", help="such as control_msgs/action/FollowJointTrajectory")
    parser.add_argument("goal", help="values of its fields, YAML")
    parser.add_argument("--interface", default="lo", help="network interface")
    parser.add_argument("--domain", type=int, help="ROS domain")
    args = parser.parse_args(arguments)
    try:
        with Node("send_action", NetworkConfig(domain=args.domain, interface=args.interface)) as node:
            ended, result = send_goal(
                node, args.name, args.type, yaml.safe_load(args.goal), lambda one: print("feedback", plain(one))
            )
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(ended, plain(result))
    return 0 if ended == "succeeded" else 1


if __name__ == "__main__":
    sys.exit(main())
