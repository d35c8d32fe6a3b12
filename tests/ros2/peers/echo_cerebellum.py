"""The least that the articles' brain can talk to: it answers each command, and publishes a state of rest."""

import node as peer
from bhd_interfaces.msg import BrainCommand, BrainResult, CerebellumState
from rclpy.node import Node
from std_msgs.msg import Bool

parser = peer.options(__doc__)
parser.add_argument("--hz", type=float, default=50.0, help="rate of the state topic [Hz]")
parser.add_argument("--answers", type=int, default=1, help="results for each command")
args = parser.parse_args()


class Echo:
    def __init__(self, node: Node) -> None:
        self.stopped = False
        self.results = node.create_publisher(BrainResult, "/brain/result", 10)
        self.states = node.create_publisher(CerebellumState, "/cerebellum/state", 10)
        node.create_subscription(BrainCommand, "/brain/command", self.answer, 10)
        node.create_subscription(Bool, "/emergency_stop", self.stop, 10)
        node.create_timer(1 / args.hz, self.publish)
        self.commands = 0

    def answer(self, command: BrainCommand) -> None:
        self.commands += 1
        for _ in range(args.answers):
            message = "emergency stop" if self.stopped else "reached"
            result = BrainResult(task_id=command.task_id, success=not self.stopped, message=message)
            self.results.publish(result)
        position = command.target_pose.position
        peer.log("command", task_id=command.task_id, position=[position.x, position.y, position.z])

    def stop(self, press: Bool) -> None:
        self.stopped |= press.data

    def close(self) -> None:
        peer.log("summary", commands=self.commands)

    def publish(self) -> None:
        state = CerebellumState(joint_positions=[0.0] * 6, joint_velocities=[0.0] * 6, emergency_stop=self.stopped)
        self.states.publish(state)


if __name__ == "__main__":
    peer.run(lambda node: Echo(node("echo_cerebellum")).close, args.seconds)
