"""Laws of the navigator beside those of `test_driving.py`: symmetry, the last turn, its map, and what it achieves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import Arena, make_arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.navigation.goal_map import CELL, GoalMap
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.task import Event, episode_seed
from tests.cases import each_case
from tests.policies.navigation import test_driving as driving
from tests.policies.navigation.test_driving import ACTIONS, BURGER, names_of

OPEN = np.full(360, 3.5)


def bound(n: int = 1, beams: int = 360) -> NavigatorBrain:
    return driving.bound(NavigatorBrain, n, beams)


def see(brain: NavigatorBrain, goal: np.ndarray, scan: np.ndarray = OPEN) -> np.ndarray:
    return driving.see(brain, scan, goal=goal)


def goal_at(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return np.array([[x, y, math.cos(yaw), math.sin(yaw)]])


def run(scenes: list[Arena] | list[int], n: int = 8) -> list[Episode]:
    """Drive in scenes, or in those that the task makes from seeds."""

    class Task(NavigateTask):
        def sample(self, seed: int) -> Arena:
            scene = scenes[seed]
            return scene if isinstance(scene, Arena) else super().sample(scene)

    config, n = TurtleBot3Config(), min(n, len(scenes))
    loop = EpisodeLoop(Simulation(config, n), Task(NavigateConfig(), n, config.fps), NavigatorBrain())
    return list(loop.run([EpisodeSpec(index, index) for index in range(len(scenes))]))


@each_case("beams", [36, 90, 360])
def test_it_drives_to_a_goal_ahead(beams: int) -> None:
    forward, turn = see(bound(beams=beams), goal_at(3.0, 0.0), np.full(beams, 3.5))[0]
    assert forward > 0.19
    assert abs(turn) < 0.4  # at most to the heading beside it: the map's cells do not tell the two apart


@each_case("side", [-1, 1])
@each_case("distance", [0.5, 2.0])
def test_it_turns_to_a_goal_beside_it(side: int, distance: float) -> None:
    assert side * see(bound(), goal_at(0.0, side * distance))[0, 1] > 0.5


def test_a_mirrored_scene_is_driven_mirrored() -> None:
    rng = np.random.default_rng(4)
    n = 40
    scan = np.clip(np.cumsum(rng.normal(0, 0.1, (n, 360)), axis=1) / 2 + 1.5, 0.3, 3.5)
    goal = np.vstack([goal_at(*rng.uniform(-3, 3, 2), rng.uniform(-3, 3)) for _ in range(n)])
    mirrored_scan = np.roll(scan[:, ::-1], 1, axis=1)
    mirrored_goal = goal * (1, -1, 1, -1)
    action, mirrored = see(bound(n), goal, scan), see(bound(n), mirrored_goal, mirrored_scan)
    same = np.isclose(action[:, 0], mirrored[:, 0]) & np.isclose(action[:, 1], -mirrored[:, 1])
    # Two paths of one price differ in their order alone.
    assert same.mean() > 0.9


@pytest.mark.parametrize("side", [-1, 1])
def test_at_the_goal_it_turns_to_its_heading_and_rests(side: int) -> None:
    brain = bound()
    forward, turn = see(brain, goal_at(0.03, 0.0, side * 1.0))[0]
    assert (forward, np.sign(turn)) == (0.0, side)
    assert see(brain, goal_at(0.03, 0.0, side * 0.02))[0].tolist() == [0.0, 0.0]
    assert see(brain, goal_at(0.07, 0.0, 0.0))[0].tolist() == [0.0, 0.0]  # a little off, it stays
    assert see(brain, goal_at(0.09, 0.0, 0.0))[0, 0] > 0
    assert see(brain, goal_at(0.03, 0.0, 0.0))[0].tolist() == [0.0, 0.0]
    brain.reset(np.arange(1), [0], 1)
    assert see(brain, goal_at(0.07, 0.0, 0.0))[0, 0] > 0  # in another episode it has not been there


@each_case("bad", [math.nan, math.inf])
@each_case("column", range(4))
def test_without_a_goal_it_stands_and_goes_on_with_one(bad: float, column: int) -> None:
    brain, goal = bound(2), np.vstack([goal_at(2.0, 0.0)] * 2)
    lost = goal.copy()
    lost[0, column] = bad
    scan = np.vstack([OPEN, OPEN])
    action = see(brain, lost, np.vstack([driving.inside_box(360, 3.5, 0.5, 3.5, 3.5), OPEN]))
    assert action[0].tolist() == [0.0, 0.0]
    assert action[1, 0] > 0.19
    assert see(brain, goal, scan)[0].tolist() == see(bound(2), goal, scan)[0].tolist()  # what it saw was nowhere


def test_ways_lead_around_what_was_seen_and_are_planned_again_only_where_it_is_in_the_way() -> None:
    goal_map = GoalMap(1)
    assert goal_map.blocked[0]
    assert goal_map.plan(0, -2.0, 0.0)
    assert goal_map.way_left(np.array([[-2.0]]), np.array([[0.0]]))[0, 0] == pytest.approx(2.0, rel=0.01)
    far = np.linspace(1.5, 2.0, 20)[None]
    goal_map.mark(np.zeros((1, 20)) - 1.0, far, np.ones((1, 20), np.bool_))
    assert not goal_map.blocked[0]
    assert goal_map.news[0] > 5
    wall = np.linspace(-1.0, 1.0, 81)[None]
    goal_map.mark(np.zeros((1, 81)) - 1.0, wall, np.ones((1, 81), np.bool_))
    assert goal_map.blocked[0]
    assert goal_map.plan(0, -2.0, 0.0)
    assert not goal_map.blocked[0]
    assert goal_map.way_left(np.array([[-2.0]]), np.array([[0.0]]))[0, 0] > 2 * math.hypot(1.0, 1.0)
    goal_map.forget(np.array([0]))
    assert goal_map.plan(0, -2.0, 0.0)
    assert goal_map.way_left(np.array([[-2.0]]), np.array([[0.0]]))[0, 0] == pytest.approx(2.0, rel=0.01)


def test_a_closed_ring_around_the_robot_is_no_way() -> None:
    goal_map = GoalMap(1)
    angle = np.linspace(0, 2 * math.pi, 400)[None]
    goal_map.mark(-2.0 + 0.5 * np.cos(angle), 0.5 * np.sin(angle), np.ones((1, 400), np.bool_))
    assert not goal_map.plan(0, -2.0, 0.0)


def test_beyond_the_map_the_distance_counts() -> None:
    goal_map = GoalMap(1)
    assert not goal_map.plan(0, 30.0, 0.0)
    near, far = goal_map.way_left(np.array([[20.0, 30.0]]), np.array([[0.0, 0.0]]))[0]
    assert far - near == pytest.approx(10.0, abs=CELL)
    assert see(bound(), goal_at(30.0, 0.0))[0, 0] > 0.19  # it sets off


def test_it_reaches_goals_without_touching_anything() -> None:
    seeds = [episode_seed(0, episode, "held_out") for episode in range(3)]
    outcomes = [episode.outcome for episode in run(seeds)]
    assert [outcome.event for outcome in outcomes] == [Event.SUCCESS] * 3
    assert np.mean([outcome.score for outcome in outcomes]) > 0.85


def test_it_gets_out_of_a_dead_end_to_a_goal_behind_its_wall() -> None:
    walls = [Shape("box", 0.5, 0.0, 0.0, 0.03, 0.6)]
    walls += [Shape("box", -0.1, side * 0.6, 0.0, 0.6, 0.03) for side in (-1, 1)]
    empty = make_arena("empty", 0)
    scene = replace(empty, shapes=(*empty.shapes, *walls), start=(0.0, 0.0, 0.0), goal=(1.525, 0.025, 2.0))
    (episode,) = run([scene])
    assert episode.outcome.success
    assert episode.outcome.score > 0.8


def test_what_it_cannot_drive_is_refused_with_what_is_missing() -> None:
    with pytest.raises(ConfigError, match=r"'navigator' needs the environment feature.*goal_x.*does not report"):
        NavigatorBrain().bind(RobotFeatures(names_of(90), ACTIONS, 10, (), body=BURGER))
    with pytest.raises(ConfigError, match="received none"):
        bound().act(Observation(names_of(360), np.zeros((1, 362))))
