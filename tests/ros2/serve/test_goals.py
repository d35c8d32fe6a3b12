"""Pose goals of a base: driven to by the navigator, and ended in exactly one result."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, SendResult
from bhd_lerobot.control.motion.supervision import SETTLING_S
from bhd_lerobot.control.motion.trajectory import MAX_DURATION_S
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.ros2.live.node import Received
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.serve.goals import ArmGoals, BaseGoals
from bhd_lerobot.ros2.serve.server import Counts, Output, Server, State, Topics
from tests.ros2.feed import ODOMETRY, odometry

FPS = 10


class Base:
    """A simulated base in lockstep, with as much of a `LiveHost` as goals use."""

    def __init__(self) -> None:
        self.config = TurtleBot3Config(odometry=True, fps=FPS)
        self.simulation = Simulation(self.config)
        arena = make_arena("turtlebot3_world", 0, robot_radius=self.config.body().drive.radius)
        self.simulation.reset(np.zeros(1, np.intp), [arena], [0])
        self.rates, self.body = self.simulation.rates, self.simulation.body
        self.observation_names, self.sensed_names = self.simulation.observation_names, self.simulation.sensed_names
        self.action_names = self.simulation.action_names
        self.bridge: Any = self
        self.sent: list[NDArray[np.float64]] = []

    @property
    def latest(self) -> dict[str, Any]:
        return {"state": self.simulation.cerebellum.states[0], "observation": self.simulation.observe().state}

    @property
    def estop_pressed(self) -> bool:
        return self.simulation.estop_pressed

    @property
    def modes(self) -> NDArray[np.int8]:
        return self.simulation.cerebellum.mode

    def send(self, values: NDArray[np.float64]) -> SendResult:
        self.sent.append(values.copy())
        return self.simulation.bridge.send(values)


def goal(name: str, x: float = 0.5, y: float = 0.0, yaw: float = 0.0, **options: Any) -> BrainCommand:
    pose = Pose((x, y, 0.0), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)))
    return BrainCommand(name, target_pose=pose, **{"timeout_s": 60.0, **options})


def run(base: Base, goals: BaseGoals, frames: int) -> list[CommandResult]:
    results = []
    for _ in range(frames):
        now = base.simulation.tick * NANOSECONDS // base.rates.control_hz
        goals.poll(now)
        results += goals.take_results()
        base.simulation.bridge.advance_frame()
    return results


@pytest.mark.parametrize("frame", ["odom", "base_footprint"])
def test_goals_are_reached_within_the_tolerances(frame: str) -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    run(base, goals, 1)
    assert goals.submit(goal("a", 1.0, 0.0, 1.0), frame) is None
    first = run(base, goals, 300)
    assert [(one.task_id, one.success) for one in first] == [("a", True)]
    np.testing.assert_allclose(base.latest["state"]["odometry"], [1.0, 0.0, 1.0], atol=0.12)
    assert goals.submit(goal("b", 0.3, 0.0, 0.5), frame) is None
    assert [(one.task_id, one.success) for one in run(base, goals, 300)] == [("b", True)]
    expected = [0.3, 0.0, 0.5] if frame == "odom" else [1 + 0.3 * math.cos(1), 0.3 * math.sin(1), 1.5]
    np.testing.assert_allclose(base.latest["state"]["odometry"], expected, atol=0.25)


@pytest.mark.law
def test_a_goal_in_odom_is_in_the_frame_of_the_odometry_that_the_robot_publishes() -> None:
    """It began elsewhere and earlier than that of a bridge, whose odometry nobody sees."""
    base, waiting = Base(), list[Received]()

    def arrives(x: float, y: float, yaw: float) -> None:
        tree = odometry(yaw=yaw, sign=-1.0)
        tree["pose"]["pose"]["position"] = {"x": x, "y": y}
        waiting.append(Received(ODOMETRY, encode(ODOMETRY, tree, 1)[0], 0, 0))

    def take() -> list[Received]:
        taken, waiting[:] = list(waiting), []
        return taken

    goals = BaseGoals(base, SimpleNamespace(topic="rt/tb3_1/odom", take=take))  # type: ignore[arg-type]
    run(base, goals, 1)
    arrives(math.nan, 0.0, 0.0)
    refusal = goals.submit(goal("early"), "odom")
    assert refusal is not None
    assert (refusal.code, refusal.message) == (
        ResultCode.BAD_TARGET,
        "The frame is 'odom', and the robot's odometry has not been received on /tb3_1/odom.",
    )
    arrives(9.0, 9.0, 0.0)
    arrives(5.0, -3.0, 2.0)
    x, y = 5.0 + 0.8 * math.cos(2.0), -3.0 + 0.8 * math.sin(2.0)
    assert goals.submit(goal("ahead", x, y, 2.5), "odom") is None
    assert [one.success for one in run(base, goals, 300)] == [True]
    np.testing.assert_allclose(base.latest["state"]["odometry"], [0.8, 0.0, 0.5], atol=0.18)
    assert goals.submit(goal("back", 5.0, -3.0, 2.0), "odom") is None  # nothing has come meanwhile
    assert [one.success for one in run(base, goals, 300)] == [True]
    np.testing.assert_allclose(base.latest["state"]["odometry"][:2], 0.0, atol=0.12)


def test_speed_is_limited() -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    assert goals.submit(goal("slow", max_velocity=0.05), "odom") is None
    run(base, goals, 50)
    assert 0.04 < max(action[0, 0] for action in base.sent) <= 0.05


def test_a_base_speeds_up_no_faster_than_the_goal_says_and_brakes_all_the_same() -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    for number, rise in enumerate((0.05, 10.0)):
        base.sent.clear()
        assert goals.submit(goal(str(number), 1.0 - number, max_acceleration=rise), "odom") is None
        assert [one.success for one in run(base, goals, 300)] == [True]
        speeds = np.abs([action[0, 0] for action in base.sent])
        steps = np.diff(speeds, prepend=0.0)
        assert (steps.max() <= 0.05 / FPS + 1e-6) == (rise == 0.05)
        assert speeds.max() > 0.1


def test_a_slow_goal_has_the_time_that_it_takes() -> None:
    """A message has no time-out of its own: what an arm's planner plans, and a base can do, is not cut off."""
    assert ArmGoals.timeout_s > MAX_DURATION_S + SETTLING_S
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    assert goals.submit(goal("slow", 1.0, max_velocity=0.05, timeout_s=10.0), "odom") is None
    assert [one.success for one in run(base, goals, 400)] == [True]


@pytest.mark.law
def test_each_goal_ends_in_one_result_whatever_ends_it() -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    goals.submit(goal("first", 1.5), "odom")
    run(base, goals, 5)
    goals.submit(goal("second", 1.0), "odom")
    assert [one.code for one in run(base, goals, 5)] == [ResultCode.PREEMPTED]
    goals.interrupt()
    goals.interrupt()
    assert [one.code for one in run(base, goals, 1)] == [ResultCode.REPLACED_BY_SETPOINT]
    goals.submit(goal("late", 1.5, timeout_s=0.5), "odom")
    assert [one.code for one in run(base, goals, 20)] == [ResultCode.TIMEOUT]
    np.testing.assert_array_equal(base.sent[-1], np.zeros((1, 2)))
    goals.submit(goal("stopped", 1.5), "odom")
    base.simulation.estop()
    assert [one.code for one in run(base, goals, 5)] == [ResultCode.ESTOP]


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (goal(""), ResultCode.BAD_TARGET),
        (goal("known"), ResultCode.DUPLICATE_ID),
        (goal("a", math.nan), ResultCode.NON_FINITE),
        (BrainCommand("a", target_pose=Pose((0, 0, 0), (0, 0, 0, 0.5))), ResultCode.NOT_NORMALISED),
        (goal("a", max_velocity=-1.0), ResultCode.BAD_VELOCITY),
        (goal("a", max_acceleration=math.nan), ResultCode.BAD_ACCELERATION),
    ],
)
def test_what_cannot_be_followed_is_refused(command: BrainCommand, code: ResultCode) -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    goals.submit(goal("known"), "odom")
    refusal = goals.submit(command, "odom")
    assert refusal is not None
    assert (refusal.task_id, refusal.success, refusal.code) == (command.task_id, False, code)
    assert not goals.take_results()


def test_a_stopped_robot_takes_no_goal() -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    base.simulation.estop()
    run(base, goals, 1)
    refusal = goals.submit(goal("a"), "odom")
    assert refusal is not None
    assert refusal.code == ResultCode.ESTOP


def test_refusals_of_a_goal_that_is_sent_again_and_again_are_not_kept() -> None:
    """They are not among the results of the cerebellum, from which the others are taken out."""
    refusal = CommandResult("again", False, ResultCode.DUPLICATE_ID, "It has not ended yet.")
    other = CommandResult("", False, ResultCode.BAD_TARGET, "It has no name.")
    answers = [refusal, refusal, other]
    bridge = SimpleNamespace(submit=lambda _: answers.pop(0), take_results=lambda: [other])
    goals = ArmGoals(SimpleNamespace(bridge=bridge))  # type: ignore[arg-type]
    for _ in range(3):
        goals.submit(goal("again"), "base")
    assert not goals.take_results()
    assert not goals._refused


@pytest.mark.law
def test_what_others_wait_for_is_sent_whatever_ends_a_server() -> None:
    ended: list[bool] = []

    def fail(_: State) -> None:
        raise RealtimeError("The cerebellum's process was killed.")

    class Failing(Topics):
        outputs = (Output(10.0, fail),)

        def end(self) -> None:
            ended.append(True)

    bridge = SimpleNamespace(latest={"sensed_ns": 0}, reported=lambda _: None)
    server = Server(SimpleNamespace(bridge=bridge), None, [Failing()], Counts())  # type: ignore[arg-type]
    with pytest.raises(RealtimeError, match="was killed"):
        server.run(lambda: False, print)
    assert ended == [True]
