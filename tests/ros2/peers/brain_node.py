"""The articles' brain: it sends pose goals on /brain/command, one after the other, and waits for the result of each.

It counts results that come twice, that nobody asked for, or never.
"""

import itertools
import math
import signal
import time
from typing import Any

import node as peer
from bhd_interfaces.msg import BrainCommand, BrainResult, CerebellumState
from rclpy.node import Node

parser = peer.options(__doc__)
parser.add_argument(
    "--goal",
    action="append",
    default=[],
    type=lambda text: [float(value) for value in text.split(",")],
    metavar="X,Y,YAW or X,Y,Z,QX,QY,QZ,QW",
    help="a target pose [m, rad]; several are sent one after the other; --goal=-1,0,0 where it begins with a minus",
)
parser.add_argument("--name", default="task", help="the goals are called so, and numbered from 0 on")
parser.add_argument("--frame", default="", help="frame_id of the goals' header")
parser.add_argument("--max-velocity", type=float, default=0.0)
parser.add_argument("--patience", type=float, default=60.0, help="the longest wait for a result [s]")
parser.add_argument("--linger", type=float, default=0.5, help="the wait for results that come twice, at the end [s]")
parser.add_argument("--preempt", type=float, help="send the next goal after this time, without waiting [s]")
parser.add_argument("--burst", type=int, metavar="N", help="send so many goals at once, the given ones in turn")
parser.add_argument("--depth", type=int, default=10, help="of the queues of goals and results")
args = parser.parse_args()
if args.burst:
    args.goal = list(itertools.islice(itertools.cycle(args.goal), args.burst))


class Brain:
    def __init__(self, node: Node) -> None:
        self.node = node
        self.commands = node.create_publisher(BrainCommand, "/brain/command", args.depth)
        node.create_subscription(BrainResult, "/brain/result", self.on_result, args.depth)
        node.create_subscription(CerebellumState, "/cerebellum/state", self.on_state, 10)
        self.sent: dict[str, float] = {}  # task -> when [s]
        self.results: dict[str, list[dict[str, Any]]] = {}
        self.states = 0
        self.finished: float | None = None
        node.create_timer(0.02, self.act)

    def act(self) -> None:
        now = time.monotonic()
        # What is sent the moment a subscription is found can be lost: wait for a state as well.
        is_heard = self.commands.get_subscription_count() and self.node.count_publishers("/brain/result")
        if not self.sent and not (is_heard and self.states):
            return
        waiting = [
            task for task, since in self.sent.items() if task not in self.results and now - since < args.patience
        ]
        last = max(self.sent.values(), default=-math.inf)
        may_send = not waiting if args.preempt is None else now - last >= args.preempt
        if len(self.sent) < len(args.goal) and may_send:
            for goal in args.goal[len(self.sent) :][: args.burst or 1]:
                self.send(goal)
        elif len(self.sent) == len(args.goal) and not waiting and args.goal:
            self.finished = self.finished or now
            if now - self.finished >= args.linger:
                signal.raise_signal(signal.SIGTERM)

    def send(self, goal: list[float]) -> None:
        command = BrainCommand(task_id=f"{args.name}-{len(self.sent)}", task_type="navigate")
        command.header.stamp = self.node.get_clock().now().to_msg()
        command.header.frame_id = args.frame
        position, orientation = command.target_pose.position, command.target_pose.orientation
        if len(goal) == 3:
            position.x, position.y = goal[:2]
            orientation.z, orientation.w = math.sin(goal[2] / 2), math.cos(goal[2] / 2)
        else:
            position.x, position.y, position.z = goal[:3]
            orientation.x, orientation.y, orientation.z, orientation.w = goal[3:]
        command.max_velocity = args.max_velocity
        self.sent[command.task_id] = time.monotonic()
        self.commands.publish(command)
        peer.log("command", task_id=command.task_id, goal=goal)

    def on_result(self, result: BrainResult) -> None:
        now = time.monotonic()
        took = now - self.sent[result.task_id] if result.task_id in self.sent else None
        line = {"task_id": result.task_id, "success": result.success, "message": result.message, "took": took}
        self.results.setdefault(result.task_id, []).append(line)
        peer.log("result", **line)

    def on_state(self, _: CerebellumState) -> None:
        self.states += 1

    def conclude(self) -> None:
        peer.log(
            "summary",
            sent=len(self.sent),
            once=sum(len(self.results.get(task, [])) == 1 for task in self.sent),
            twice=sum(len(lines) > 1 for lines in self.results.values()),
            never=sum(task not in self.results for task in self.sent),
            unknown=sum(task not in self.sent for task in self.results),
        )


if __name__ == "__main__":
    peer.run(lambda node: Brain(node("brain_node")).conclude, args.seconds)
