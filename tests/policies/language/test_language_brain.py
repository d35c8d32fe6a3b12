"""The brain that carries out instructions: which object it goes for, what it refuses, and what it does at the end."""

import dataclasses
import json

import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import OBJECT_FIELDS, TableObject
from bhd_lerobot.bodies.ur import MAX_OPENING
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.language.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.manipulation.skills import Plan, SceneObject, Skill, TextPlanner, make_plan
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.task import episode_seed
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case
from tests.policies.arm_desk import BOX, CUP, Desk, episodes, scene

BLUE_CUP = TableObject("cup", "blue", 0.03, 0.03, 0.10, 0.6, -0.2)
TABLE = (CUP, BOX, BLUE_CUP)  # red cup, blue box, blue cup


def desk(*instructions: str, **options) -> Desk:
    brain = LanguageBrain(**options)
    return Desk(brain, [scene(*TABLE)] * len(instructions), list(instructions))


def place(one: Desk, sim: int = 0) -> tuple[float, float]:
    """Return where the first goal of a simulation brings the tool."""
    pose = one.given[sim][0].target_pose
    assert pose is not None
    return pose.position[:2]


def carry_out(one: Desk, sim: int = 0) -> list[str]:
    """Let all goals succeed; return their names."""
    one.state[sim, 1] = 0.06
    while one.given[sim][-1].task_id.split("-")[1] != "lift":
        assert one.end(sim) is not None
    one.lift(sim, one.brain.plan(sim)["target"])
    while one.end(sim) is not None:
        pass
    return one.steps(sim)


def test_it_does_not_look_at_which_object_the_task_marks() -> None:
    goals = []
    for marked in (0, 1, 2, None):
        one = desk("pick up the blue box")
        one.table[:, :, OBJECT_FIELDS.index("target")] = 0.0
        if marked is not None:
            one.table[:, marked, OBJECT_FIELDS.index("target")] = 1.0
        one.look()
        carry_out(one)
        goals.append(one.given[0])
    assert goals[0] == goals[1] == goals[2] == goals[3]


@each_case(
    ("instruction", "why"),
    [
        ("pick up the cup", "fits 2 objects"),
        ("拿起杯子", "2"),
        ("pick up the green box", "Nothing on the table is"),
        ("dance with the blue box", "not understood"),
        ("", "empty"),
        ("pick up the red cup and the blue box", "not understood"),
    ],
)
def test_what_it_does_not_understand_it_does_not_do_and_reports_why(instruction: str, why: str) -> None:
    one = desk(instruction, "pick up the blue box")
    assert set(one.look()) == {1}  # the other goes on
    assert one.look() == {}
    subtask = one.brain.subtasks()[0]
    assert subtask.startswith("cannot: ")
    assert why in subtask
    assert one.brain.plan(0)["problem"] in subtask
    assert one.brain.plan(0)["steps"] == []


def test_an_instruction_of_its_own_counts_more_than_the_task_s() -> None:
    one = desk("grab the red cup", config=LanguageBrainConfig(instruction="grab the blue cup"))
    one.look()
    assert place(one) == pytest.approx((BLUE_CUP.x, BLUE_CUP.y))
    assert one.brain.plan(0)["instruction"] == "grab the blue cup"
    assert one.brain.parameters()["instruction"] == "grab the blue cup"


def test_an_object_that_was_not_seen_is_not_on_the_table() -> None:
    one = desk("pick up the blue cup", "pick up the cup")
    one.table[:, 2, 3] = np.nan
    assert set(one.look()) == {1}  # now there is one cup only
    assert "Nothing on the table" in one.brain.subtasks()[0]
    assert place(one, 1) == pytest.approx((CUP.x, CUP.y))


def planned(*skills: Skill) -> TextPlanner:
    """Return a planner on top of a language model that always answers these skills, with the blue box."""
    answer = {"target": 1, "steps": [{"skill": skill.value, "object": 1} for skill in skills]}
    return TextPlanner(lambda _: json.dumps(answer))


GRASP = (Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT)


@pytest.mark.parametrize("skills", [(Skill.PLACE,), (Skill.HOLD, Skill.PLACE)])
def test_what_is_to_be_put_down_is_put_down_where_it_stood_and_let_go(skills: tuple[Skill, ...]) -> None:
    one = desk("put it down", planner=planned(*GRASP, *skills))
    one.look()
    assert carry_out(one) == ["above", "down", "close", "lift", "put", "release"]
    goals = {goal.task_id.split("-")[1]: goal for goal in one.given[0]}
    assert goals["put"].target_pose == goals["down"].target_pose
    assert goals["put"].motion == "line"
    assert 2 * BOX.size_y < (goals["release"].gripper or 0) <= MAX_OPENING
    assert one.brain.subtasks()[0] == "done"


def test_another_planner_is_called_once_with_what_is_on_the_table() -> None:
    requests: list[tuple[str, list[SceneObject]]] = []

    class Mine:
        def plan(self, instruction: str, objects) -> Plan:
            requests.append((instruction, list(objects)))
            return make_plan(instruction, objects[2], (*GRASP, Skill.HOLD))

    one = desk("whatever", planner=Mine())
    one.look()
    carry_out(one)
    assert place(one) == pytest.approx((BLUE_CUP.x, BLUE_CUP.y))
    ((instruction, objects),) = requests
    assert instruction == "whatever"
    assert [thing.name for thing in objects] == ["red cup", "blue box", "blue cup"]


def test_a_planner_that_refuses_is_quoted() -> None:
    one = desk("x", planner=TextPlanner(lambda _: '{"error": "I would rather not"}'))
    assert one.look() == {}
    assert "I would rather not" in one.brain.subtasks()[0]


def test_it_picks_what_the_task_asks_for_in_both_languages() -> None:
    config = PickConfig(language="any", min_objects=3, randomisation=RandomisationConfig(enabled=True))
    done = episodes(LanguageBrain(), PickTask, config, [episode_seed(21, k, "train") for k in range(4)])
    assert {one.instruction.isascii() for one in done} == {True, False}
    for one in done:
        assert one.outcome.success, one.plan
        assert one.plan["target"] == one.scene.target_object


@pytest.mark.parametrize("end", ["hand over", "place"])
def test_in_the_end_the_object_is_where_it_was_to_be(end: str) -> None:
    seed = episode_seed(2, 0, "train")
    # Long enough in the air for the task to see all of it.
    config = PickConfig(max_objects=1, hold_s=8.0)
    thing = PickTask(config, 1, 25).sample(seed).objects[0]
    brain = LanguageBrain(LanguageBrainConfig(instruction=f"hand me the {thing.name}"))
    if end == "place":
        answer = {"target": 0, "steps": [{"skill": s.value, "object": 0} for s in (*GRASP, Skill.PLACE)]}
        brain = LanguageBrain(planner=TextPlanner(lambda _: json.dumps(answer)))
    one = episodes(brain, PickTask, dataclasses.replace(config, duration_s=12.0), [seed])[0]
    names = [f"object_0_{name}" for name in ("x", "y", "z")]
    task = PickTask(config, 1, 25)
    last = one.columns[keys.ENVIRONMENT_STATE][-1, [task.environment_names.index(name) for name in names]]
    if end == "hand over":
        goal = one.commands[-1][1].target_pose
        assert goal is not None
        assert last == pytest.approx(goal.position, abs=0.05)  # it hangs a little lower than the tool's centre
        assert last[2] > 0.2
        assert one.outcome.success
    else:
        # The pick task ends it when it is let go: to it, this is a drop.
        assert last == pytest.approx((thing.x, thing.y, thing.height / 2), abs=0.02)
        assert one.outcome.event.cause == "dropped"
        assert one.commands[-1][1].task_id.endswith("release")
