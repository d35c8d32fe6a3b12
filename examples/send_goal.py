"""Send one goal to a simulated UR5, wait, print feedback and result.

    python examples/send_goal.py
    python examples/send_goal.py --position 0.3 0.2 0.4 --max-velocity 0.5
    python examples/send_goal.py --estop-after=1

The last one presses the emergency stop after a second and shows that the next goal is refused.
"""

import argparse
import sys
from collections.abc import Sequence

from bhd_lerobot.control.commands import BrainCommand, Pose
from bhd_lerobot.errors import BhdError
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.ur import UR5

FEEDBACK_S = 0.2  # simulated time between two lines of feedback [s]


def main(arguments: Sequence[str] | None = None) -> int:
    """Send the goal; return 0 if it succeeded, or if it was stopped as asked, 1 otherwise, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--position", nargs=3, type=float, default=[0.3, 0.2, 0.4], metavar=("X", "Y", "Z"))
    # The tool points down.
    parser.add_argument("--quaternion", nargs=4, type=float, default=[0.0, 1.0, 0.0, 0.0], metavar=("W", "X", "Y", "Z"))
    parser.add_argument("--motion", choices=("joint", "line"), default="joint")
    parser.add_argument("--max-velocity", type=float, help="rad/s of the fastest joint, m/s of the tool on a line")
    parser.add_argument("--max-acceleration", type=float, help="likewise, rad/s^2 or m/s^2")
    parser.add_argument("--timeout", type=float, default=20.0, help="s")
    parser.add_argument("--estop-after", type=float, metavar="SECONDS", help="press the emergency stop at this time")
    args = parser.parse_args(arguments)
    if args.estop_after is not None and not 0 <= args.estop_after <= args.timeout:
        parser.error(f"--estop-after is {args.estop_after}; it must be between 0 and the time-out, {args.timeout} s")
    pose = Pose(tuple(args.position), tuple(args.quaternion))
    # Slow enough to see something of it, and to stop it in the middle.
    speed = args.max_velocity if args.max_velocity is not None else 0.2 if args.motion == "line" else 0.5
    goal = BrainCommand(
        "goal-1",
        target_pose=pose,
        motion=args.motion,
        max_velocity=speed,
        max_acceleration=args.max_acceleration,
        timeout_s=args.timeout,
    )
    robot = UR5(UR5Config())
    try:
        robot.connect()
        return _run(robot, goal, args.estop_after)
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    finally:
        robot.disconnect()


def _run(robot: UR5, goal: BrainCommand, estop_after: float | None) -> int:
    bridge = robot.host.bridge
    print(f"goal     {goal.task_id}: tool to {goal.target_pose}")
    refusal = bridge.submit(goal)
    if refusal is not None:
        print(f"refused  {refusal.code.name}: {refusal.message}")
        return 1
    print("accepted")
    start, shown, stopped = bridge.now_ns, 0, False
    while True:
        bridge.advance_frame()
        seconds = (bridge.now_ns - start) / 1e9
        for result in bridge.take_results():
            print(
                f"{seconds:6.2f} s  {'succeeded' if result.success else 'failed'}  {result.code.name}: {result.message}"
            )
            if not stopped:
                if estop_after is not None:
                    print("The goal ended before the emergency stop; choose an earlier --estop-after.")
                return 0 if result.success and estop_after is None else 1
            return _after_stop(robot, goal)
        feedback = bridge.feedback()
        if feedback is not None and seconds >= shown * FEEDBACK_S:
            shown += 1
            position = robot.host.kinematics.tool(bridge.state().joint_positions[0, :-1])[:3, 3]
            print(
                f"{seconds:6.2f} s  feedback  {feedback.phase.name.lower()} {100 * feedback.progress:3.0f} %, "
                f"{feedback.remaining_s:4.2f} s left, tool at {position.round(3).tolist()}"
            )
        if estop_after is not None and seconds >= estop_after and not stopped:
            print(f"{seconds:6.2f} s  emergency stop")
            robot.estop()
            stopped = True


def _after_stop(robot: UR5, goal: BrainCommand) -> int:
    bridge = robot.host.bridge
    while bridge.state().is_moving[0]:
        bridge.advance_frame()
    print("at rest  sending the next goal")
    refusal = bridge.submit(BrainCommand("goal-2", target_pose=goal.target_pose))
    if refusal is None:
        print("accepted, though the emergency stop is latched: this is a bug")
        return 1
    print(f"refused  {refusal.code.name}: {refusal.message}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
