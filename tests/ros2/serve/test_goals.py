"""Pose goals of a base: driven to by the navigator, and ended in exactly one result."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, SendResult
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.ros2.serve.goals import BaseGoals

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


def test_speed_is_limited() -> None:
    base = Base()
    goals = BaseGoals(base)  # type: ignore[arg-type]
    assert goals.submit(goal("slow", max_velocity=0.05), "odom") is None
    run(base, goals, 50)
    assert 0.04 < max(action[0, 0] for action in base.sent) <= 0.05


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
