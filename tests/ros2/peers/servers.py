"""Servers of two services and an action.

/motor_power (SetBool) keeps what it is given; /reset_odometry (Trigger) counts its calls; --busy S delays replies.
/fibonacci (Fibonacci) appends a number each --step S; an order of 0 is refused, one over 100 is aborted after three
steps, and no goal of over 50 can be cancelled.
"""

import time

import node as peer
import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

parser = peer.options(__doc__)
parser.add_argument("--busy", type=float, default=0.0, help="before a reply [s]")
parser.add_argument("--step", type=float, default=0.02, help="of a goal [s]")
args = parser.parse_args()


class Servers:
    def __init__(self, node: Node) -> None:
        self.node = node
        self.resets = 0
        node.create_service(SetBool, "/motor_power", self.on_motor_power)
        node.create_service(Trigger, "/reset_odometry", self.on_reset)
        self.action = ActionServer(
            node,
            Fibonacci,
            "/fibonacci",
            self.execute,
            goal_callback=lambda goal: GoalResponse.ACCEPT if goal.order else GoalResponse.REJECT,
            cancel_callback=lambda goal: CancelResponse.REJECT if goal.request.order > 50 else CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def on_motor_power(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        time.sleep(args.busy)
        peer.log("motor_power", data=request.data)
        response.success, response.message = True, f"motor power is {'on' if request.data else 'off'}"
        return response

    def on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time.sleep(args.busy)
        self.resets += 1
        peer.log("reset_odometry", resets=self.resets)
        response.success, response.message = True, str(self.resets)
        return response

    async def execute(self, goal: ServerGoalHandle) -> Fibonacci.Result:
        numbers = [0, 1]
        feedback = Fibonacci.Feedback()
        while len(numbers) < min(goal.request.order, 40):
            if goal.is_cancel_requested:
                goal.canceled()
                break
            if goal.request.order > 100 and len(numbers) > 4:
                goal.abort()
                break
            numbers.append(numbers[-2] + numbers[-1])
            feedback.sequence = numbers
            goal.publish_feedback(feedback)
            await self.pause(args.step)
        else:
            goal.succeed()
        result = Fibonacci.Result()
        result.sequence = numbers
        peer.log("ended", order=goal.request.order, succeeded=goal.status == GoalStatus.STATUS_SUCCEEDED)
        return result

    async def pause(self, seconds: float) -> None:
        future = rclpy.task.Future()
        timer = self.node.create_timer(seconds, lambda: future.set_result(None))
        await future
        timer.cancel()
        self.node.destroy_timer(timer)


if __name__ == "__main__":
    peer.run(lambda node: Servers(node("servers")).action.destroy, args.seconds)
