"""The scripted pick: its goals one by one on a made-up table, and a few picks in the simulator."""

import dataclasses

import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import TableObject
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.commands import CommandResult, Goals, ResultCode
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.pick import PickBrain, PickBrainConfig
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.task import Event, episode_seed
from tests.cases import each_case
from tests.policies.arm_desk import BOX, CUP, OBSERVED, Desk, episodes, scene

GRASPED = 0.06  # [m] the opening when the cup is between the fingers


def grasp(desk: Desk, sim: int = 0, opening: float = GRASPED) -> None:
    """Let a simulation get to the end of its grasp."""
    while desk.steps(sim)[-1] != "close":
        assert desk.end(sim) is not None
    desk.state[sim, 1] = opening


@pytest.mark.law
def test_above_down_close_lift_and_done() -> None:
    desk = Desk(PickBrain(), [scene(CUP, BOX)])
    above = desk.look()[0]
    assert desk.brain.subtasks()[0] == "move the gripper to the red cup"
    assert above.target_pose is not None
    assert above.target_pose.position[:2] == pytest.approx((CUP.x, CUP.y))
    assert above.target_pose.position[2] > CUP.height + 0.1  # an open hand passes over all objects
    assert 2 * CUP.size_x < (above.gripper or 0) <= MAX_OPENING
    down = desk.end()
    assert down is not None
    assert down.target_pose is not None
    assert (down.motion, down.gripper) == ("line", None)
    assert 0 < down.target_pose.position[2] < CUP.height
    assert down.target_pose.quaternion == above.target_pose.quaternion
    close = desk.end()
    assert close is not None
    assert close.target_pose is None
    assert 0 <= (close.gripper or 0) < 2 * CUP.size_x
    desk.state[0, 1] = GRASPED
    lift = desk.end()
    assert desk.brain.subtasks()[0] == "lift the red cup"
    assert lift is not None
    assert lift.target_pose is not None
    assert lift.gripper is None  # it stays closed
    assert lift.motion == "line"
    assert lift.target_pose.position == pytest.approx(
        (*down.target_pose.position[:2], down.target_pose.position[2] + 0.15)
    )
    desk.lift(0)
    assert desk.end() is None
    assert desk.steps() == ["above", "down", "close", "lift"]
    for _ in range(3):
        assert desk.look() == {}
    plan = desk.brain.plan(0)
    assert (plan["target"], plan["problem"], plan["attempts"]) == (0, "", 1)
    assert [skill for skill, _ in plan["steps"]] == ["locate", "approach", "grasp", "lift", "hold"]


def test_a_known_camera_error_is_subtracted_from_every_position() -> None:
    error = (0.02, -0.01, 0.015)
    right = Desk(PickBrain(), [scene(CUP, BOX)])
    wrong = Desk(PickBrain(PickBrainConfig(camera_error_m=list(error))), [scene(CUP, BOX)])
    wrong.table[:, :, 3:6] += error
    for desk in (right, wrong):
        desk.look()
        grasp(desk)
        assert desk.end() is not None  # lift
        desk.lift(0)
        assert desk.end() is None
    assert wrong.steps() == right.steps() == ["above", "down", "close", "lift"]
    for one, two in zip(wrong.given[0], right.given[0], strict=True):
        assert one.gripper == two.gripper
        if two.target_pose is not None:
            assert one.target_pose is not None
            assert one.target_pose.position == pytest.approx(two.target_pose.position, abs=1e-12)
            assert one.target_pose.quaternion == pytest.approx(two.target_pose.quaternion, abs=1e-12)


def test_results_of_other_goals_are_not_its_own() -> None:
    desk = Desk(PickBrain(), [scene(CUP), scene(CUP)])
    desk.look()
    stray = [CommandResult(name, ok, ResultCode.SUCCEEDED, "") for name in ("", "1", "above") for ok in (True, False)]
    assert desk.look({0: stray}) == {}
    mine = CommandResult(desk.given[0][0].task_id, True, ResultCode.SUCCEEDED, "")
    new = desk.look({0: [*stray, mine], 7: [mine]})
    assert set(new) == {0}
    assert desk.steps(0) == ["above", "down"]


def test_a_missed_grasp_is_tried_exactly_once_more() -> None:
    desk = Desk(PickBrain(), [scene(CUP)])
    desk.look()
    grasp(desk, opening=0.031)  # closed to where it was sent: nothing between the fingers
    back = desk.end()
    assert back is not None
    assert back.target_pose is not None
    assert back.gripper == MAX_OPENING
    assert back.target_pose.position[2] > CUP.height + 0.1
    desk.put(0, 0, dataclasses.replace(CUP, x=0.55), True)  # it was pushed
    desk.end()
    assert desk.given[0][-1].target_pose.position[0] == pytest.approx(0.55)  # where it is now
    grasp(desk, opening=0.031)
    assert desk.end() is None
    assert desk.steps() == ["above", "down", "close", "back", "above", "down", "close"]
    assert desk.look() == {}
    assert "31 mm and holds nothing" in desk.brain.plan(0)["problem"]
    assert desk.brain.subtasks()[0].startswith("cannot: the gripper closed to 31 mm")
    assert desk.brain.plan(0)["attempts"] == 2


@each_case("when", ["above", "down", "close", "lift", "slips"])
def test_what_fails_or_slips_out_on_the_way_up_is_tried_again(when: str) -> None:
    desk = Desk(PickBrain(), [scene(CUP)])
    desk.look()
    desk.state[0, 1] = GRASPED
    while desk.steps()[-1] != ("lift" if when == "slips" else when):
        desk.end()
    if when == "slips":
        desk.lift(0, by=0.04)
    desk.end(success=when == "slips", message="something is in its way")
    assert desk.steps()[-1] == "back"
    problem = "the object was not lifted" if when == "slips" else "something is in its way"
    assert desk.brain.plan(0)["problem"] == problem
    desk.end()
    assert desk.steps()[-1] == "above"


def test_what_is_lifted_a_little_as_it_is_to_be_is_lifted() -> None:
    desk = Desk(PickBrain(PickBrainConfig(lift_m=0.04)), [scene(CUP)])
    desk.look()
    grasp(desk)
    desk.end()
    desk.lift(0, by=0.04)
    assert desk.end() is None
    assert desk.steps() == ["above", "down", "close", "lift"]


@each_case("attempts", [1, 2, 5])
def test_when_every_goal_fails_it_gives_up_in_the_end(attempts: int) -> None:
    desk = Desk(PickBrain(PickBrainConfig(attempts=attempts)), [scene(CUP)])
    desk.look()
    for _ in range(2 * attempts):
        if desk.end(success=False, message="no way") is None:
            break
    assert desk.look() == {}
    assert desk.brain.subtasks()[0] == "cannot: no way"
    assert desk.steps().count("above") <= attempts
    assert len(desk.steps()) <= 2 * attempts


@each_case("what", ["absent", "unmarked", "nan", "does not run"])
def test_without_a_target_it_does_nothing_and_reports_why(what: str) -> None:
    desk = Desk(PickBrain(), [scene(CUP, BOX), scene(CUP)])
    if what == "does not run":  # what such a one sees means nothing
        desk.table[0] = np.nan
        assert set(desk.look(running=np.array([False, True]))) == {1}
        return
    if what == "nan":
        desk.table[0, 0, 4] = np.nan
    else:
        desk.table[0, 0, 0 if what == "absent" else 1] = 0
    assert set(desk.look()) == {1}
    assert desk.brain.subtasks()[0].startswith("cannot: No object on the table")
    assert desk.brain.plan(0)["target"] is None


def test_what_does_not_fit_between_the_fingers_is_not_tried() -> None:
    with pytest.raises(ConfigError, match="'pick' needs the environment feature"):
        PickBrain().bind(RobotFeatures(OBSERVED, OBSERVED, 25, (), body=ur5()))
    desk = Desk(PickBrain(), [scene(TableObject("box", "green", 0.05, 0.05, 0.1, 0.5, 0.0))])
    assert desk.look() == {}
    assert "green box does not fit" in desk.brain.plan(0)["problem"]


def test_a_new_episode_starts_from_nothing() -> None:
    desk = Desk(PickBrain(), [scene(CUP), scene(CUP)])
    desk.look()
    grasp(desk, 0, opening=0.02)
    desk.end(0)
    old = CommandResult(desk.given[0][-1].task_id, True, ResultCode.SUCCEEDED, "")
    desk.brain.reset(np.array([0]), [1], 2, ["again"])
    desk.given[0].clear()
    assert desk.look({0: [old]})[0].task_id == "1-above"
    assert desk.brain.plan(0)["attempts"] == 1
    assert desk.brain.plan(0)["instruction"] == "again"
    assert desk.steps(1) == ["above"]


def test_it_picks() -> None:
    seeds = [episode_seed(11, episode, "train") for episode in range(2)]
    for episode in episodes(PickBrain(), PickTask, PickConfig(), seeds):
        assert episode.outcome.success, episode.plan
        assert episode.plan["attempts"] == 1
        assert [result.task_id for _, result in episode.results] == [command.task_id for _, command in episode.commands]


class Thief(PickBrain):
    """Moves the object away when the gripper comes down for the first time, across the line of its fingers."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__()
        self.simulation, self.moved = simulation, False

    def act(self, observation: Observation) -> Goals:
        goals = super().act(observation)
        for commands in goals.commands.values():
            if commands[0].task_id.endswith("-down") and not self.moved:
                assert commands[0].target_pose is not None
                world = self.simulation.world
                at = int(world.model.joint("object_0").qposadr[0])
                world.qpos[0, at : at + 2] += 0.05 * commands[0].target_pose.matrix()[:2, 0]
                world.forward(np.array([0]))
                self.moved = True
        return goals


def test_an_object_that_moves_away_under_the_gripper_is_picked_at_the_second_attempt() -> None:
    simulation = Simulation(UR5Config(), 1, threads=1)
    brain = Thief(simulation)
    config = PickConfig(max_objects=1, duration_s=30.0)
    episode = episodes(brain, PickTask, config, [episode_seed(5, 0, "train")], simulation=simulation)[0]
    assert brain.moved
    steps = [command.task_id.split("-")[1] for _, command in episode.commands]
    assert steps[:5] == ["above", "down", "close", "back", "above"]
    assert episode.plan["attempts"] == 2
    assert "holds nothing" in episode.plan["problem"]
    assert episode.outcome.event == Event.SUCCESS
