"""The judge, on made-up truth, and the scenes it makes: no simulator, no robot."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.bodies.arenas import BURGER_RADIUS, CLEARANCE, Arena, make_arena, random_arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.geodesic import WayField, interpolate, way_lengths
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask, goal_in_robot
from bhd_lerobot.tasks.task import Event
from tests.cases import each_case
from tests.tasks.support import Judged

FPS = 10
GOAL = (2.025, 0.025, 1.0)  # a grid point
OPEN = replace(make_arena("empty", 0), start=(-0.025, 0.025, 0.0), goal=GOAL)


class Run(Judged):
    def __init__(self, config: NavigateConfig | None = None, *scenes: Arena) -> None:
        scenes = scenes or (OPEN,)
        super().__init__(NavigateTask(config or NavigateConfig(), len(scenes), FPS), scenes)

    def frame(self, *poses: tuple[float, float, float], touched: bool = False) -> np.ndarray:
        return self.judge(BaseTruth(np.array(poses, float), np.full(self.n, touched)))

    def until_done(self, *poses: tuple[float, float, float]) -> None:
        while self.running.any():
            self.frame(*poses)


def drive_to_goal(run: Run, steps: int = 50) -> None:
    """Drive straight along x to the goal's position."""
    for x in np.linspace(-0.025, GOAL[0], steps + 1)[1:]:
        run.frame((x, GOAL[1], 0.0))


@each_case(
    "config",
    [
        NavigateConfig(),
        NavigateConfig(min_distance_m=3.0, goal_clearance_m=0.4),
        NavigateConfig(arena="turtlebot3_world"),
        NavigateConfig(arena="turtlebot3_world", random_start=True),
        NavigateConfig(arena="empty"),
    ],
)
def test_goals_are_reachable_far_enough_and_free(config: NavigateConfig) -> None:
    task = NavigateTask(config, 1, FPS)
    for seed in range(12):
        scene = task.sample(seed)
        goal, start = np.array(scene.goal), np.array(scene.start)
        assert np.hypot(*(goal - start)[:2]) >= config.min_distance_m
        assert scene.clearance(goal[:2]) >= config.goal_clearance_m
        assert -math.pi <= goal[2] <= math.pi
        task.begin(np.array([0]), [scene])  # refuses a goal without a way
        shortest = task.outcome(0, Event.NOTHING).details["shortest_m"]
        assert np.hypot(*(goal - start)[:2]) - 0.05 <= shortest < 20


def test_the_arena_of_a_seed_is_that_of_the_avoid_task() -> None:
    assert replace(NavigateTask(NavigateConfig(), 1, FPS).sample(5), goal=None) == random_arena(5)


def test_an_arena_too_small_for_the_distance_is_drawn_again() -> None:
    task = NavigateTask(NavigateConfig(min_distance_m=4.5), 1, FPS)
    scenes = [task.sample(seed) for seed in range(8)]
    assert any(replace(scene, goal=None) != random_arena(seed) for seed, scene in enumerate(scenes))
    assert scenes == [task.sample(seed) for seed in range(8)]


def test_a_distance_that_no_arena_has_is_refused_with_what_it_has() -> None:
    with pytest.raises(ConfigError, match=r"9.0 m \(task.min_distance_m\).*farthest is 4\.\d\d m"):
        NavigateTask(NavigateConfig(arena="turtlebot3_world", min_distance_m=9.0), 1, FPS)
    with pytest.raises(ConfigError, match="choose a smaller distance"):
        NavigateTask(NavigateConfig(min_distance_m=9.0), 1, FPS).sample(0)
    with pytest.raises(ConfigError, match="No place has this clearance"):
        NavigateTask(NavigateConfig(arena="empty", goal_clearance_m=3.5), 1, FPS)


@given(
    st.lists(st.floats(-5, 5), min_size=4, max_size=4),
    st.lists(st.floats(-math.pi, math.pi), min_size=3, max_size=3),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
)
def test_turning_and_moving_the_world_changes_nothing_in_the_robots_frame(places, angles, shift):
    goal, pose = np.array([[*places[:2], angles[0]]]), np.array([[*places[2:], angles[1]]])
    turn = angles[2]

    def moved(pose: np.ndarray) -> np.ndarray:
        (x, y, yaw), c, s = pose[0], math.cos(turn), math.sin(turn)
        return np.array([[c * x - s * y + shift[0], s * x + c * y + shift[1], yaw + turn]])

    np.testing.assert_allclose(goal_in_robot(moved(goal), moved(pose)), goal_in_robot(goal, pose), atol=1e-9)


@pytest.mark.law
def test_success_needs_place_heading_rest_and_time() -> None:
    run = Run()
    drive_to_goal(run)
    for _ in range(20):
        run.frame((*GOAL[:2], 0.0))  # the wrong heading
    run.frame(GOAL)  # not at rest: it turned in this frame
    for _ in range(4):
        run.frame(GOAL)
        assert run.running[0]
    run.frame(GOAL)
    assert run.events[0] == Event.SUCCESS
    outcome = run.outcome()
    assert outcome.success
    assert outcome.details["time_s"] == pytest.approx(run.frames[0] / FPS)
    assert outcome.details["error_m"] == outcome.details["error_rad"] == 0


def test_the_hold_begins_again_after_a_break() -> None:
    run = Run()
    drive_to_goal(run)
    run.frame(GOAL)
    for _ in range(4):
        run.frame(GOAL)
    run.frame((GOAL[0] + 0.004, *GOAL[1:]))  # 0.04 m/s is no rest
    for _ in range(4):
        run.frame((GOAL[0] + 0.004, *GOAL[1:]))
    assert run.running[0]
    run.frame((GOAL[0] + 0.004, *GOAL[1:]))
    assert run.events[0] == Event.SUCCESS


@each_case(
    ("off", "event"),
    [
        ((0.099, 0.0, 0.0), Event.SUCCESS),
        ((0.101, 0.0, 0.0), Event.STUCK),
        ((0.0, 0.0, math.radians(9.9)), Event.SUCCESS),
        ((0.0, 0.0, math.radians(-10.1)), Event.STUCK),
        ((0.0, 0.0, 2 * math.pi), Event.SUCCESS),
    ],
)
def test_the_tolerances_are_the_borders(off: tuple[float, float, float], event: Event) -> None:
    run = Run()
    drive_to_goal(run)
    run.until_done((GOAL[0] + off[0], GOAL[1] + off[1], GOAL[2] + off[2]))
    assert run.events[0] == event


def test_a_touch_is_a_collision_before_all_else() -> None:
    run = Run(NavigateConfig(hold_s=0.1))
    drive_to_goal(run)
    run.frame(GOAL)
    run.frame(GOAL, touched=True)
    assert run.events[0] == Event.COLLISION
    assert run.outcome().score == 0


def test_the_end_of_time_is_a_time_out_and_standing_still_is_stuck() -> None:
    run = Run(NavigateConfig(duration_s=5.0))
    for frame in range(50):
        run.frame((-0.025 + 0.01 * frame, 0.025, 0.0))
    assert (run.frames[0], run.events[0]) == (50, Event.TIMEOUT)
    run = Run()
    run.until_done(OPEN.start)
    assert (run.frames[0], run.events[0]) == (100, Event.STUCK)


def test_score_is_success_weighted_by_path_length() -> None:
    run = Run()
    drive_to_goal(run)
    run.until_done(GOAL)
    assert run.outcome().details["shortest_m"] == pytest.approx(2.05)
    assert run.outcome().score == pytest.approx(1.0)
    run = Run()
    for y in np.linspace(0, 1.025, 30)[1:]:
        run.frame((-0.025, 0.025 + y, 0.0))
    for y in np.linspace(1.025, 0, 30)[1:]:
        run.frame((-0.025, 0.025 + y, 0.0))
    drive_to_goal(run)
    run.until_done(GOAL)
    assert run.outcome().details["path_m"] == pytest.approx(4.1)
    assert run.outcome().score == pytest.approx(0.5)


def test_the_rewards_of_a_success_sum_to_one_whatever_the_way() -> None:
    for detour in (0.0, 1.0, -2.9):
        run = Run()
        run.frame((-0.025, 0.025 + detour, 0.0))
        run.frame((-1.0, 0.025 + detour, 2.0))
        drive_to_goal(run)
        run.until_done(GOAL)
        assert run.rewards[0] == pytest.approx(1.0, abs=1e-12)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-4, 4)), min_size=1, max_size=20), st.booleans()
)
def test_without_success_the_sum_stays_in_its_bounds(poses: list[tuple[float, float, float]], crash: bool) -> None:
    scene = NavigateTask(NavigateConfig(), 1, FPS).sample(11)
    run = Run(None, scene)
    for pose in poses:
        run.frame(pose)
    assert -0.5 <= run.rewards[0] <= 0.5
    before = run.rewards[0]
    if crash:
        assert run.frame(poses[0], touched=True)[0] == -0.5
        assert run.rewards[0] == before - 0.5


def test_the_reward_is_the_share_of_the_way_that_was_covered() -> None:
    run = Run()
    reward = run.frame((0.975, 0.025, 0.0))
    assert reward[0] == pytest.approx(0.5 * 1.0 / 2.05)
    assert run.frame((0.975, 0.025, 3.0))[0] == pytest.approx(0.0)  # a turn far from the goal
    assert run.frame((-0.025, 0.025, 0.0))[0] == pytest.approx(-0.5 * 1.0 / 2.05)


def test_a_way_around_a_wall_has_the_length_of_its_geometry() -> None:
    wall = Shape("box", 0.0, -1.0, 0.0, 0.03, 2.0)  # leaves an opening at y > 1
    arena = replace(make_arena("empty", 0), start=(-1.0, -1.0, 0.0), goal=(1.025, -0.975, 0.0))
    arena = replace(arena, shapes=(*arena.shapes, wall))
    task = NavigateTask(NavigateConfig(), 1, FPS)
    task.begin(np.array([0]), [arena])
    # Straight to a circle around the wall's corner, around it, along the wall's end, and the same again.
    around, apart = BURGER_RADIUS + CLEARANCE, math.hypot(0.97, 2.0)
    turned = math.atan2(2.0, 0.97) + math.asin(around / apart)
    geometry = 2 * (math.sqrt(apart**2 - around**2) + turned * around) + 0.06
    assert task.outcome(0, Event.NOTHING).details["shortest_m"] == pytest.approx(geometry, rel=0.04)


@given(st.integers(0, 10_000))
def test_ways_are_at_least_straight_and_at_most_a_little_longer_in_the_open(seed: int) -> None:
    goal = tuple(np.random.default_rng(seed).integers(0, 30, 2))
    lengths = way_lengths(np.ones((30, 30), np.bool_), goal)
    rows, columns = np.mgrid[:30, :30]
    straight = np.hypot(rows - goal[0], columns - goal[1])
    assert (lengths >= straight - 1e-9).all()
    assert (lengths <= 1.028 * straight + 1e-9).all()


def test_no_way_squeezes_between_two_cells_that_meet_at_a_corner() -> None:
    free = np.ones((4, 4), np.bool_)
    free[[0, 1, 2, 3], [2, 2, 1, 1]] = False  # two walls that meet diagonally
    assert np.isinf(way_lengths(free, (0, 0))[:, 3]).all()


def test_between_grid_points_lengths_are_linear_and_outside_as_at_the_border() -> None:
    field = WayField(OPEN, GOAL[:2])
    fields, origin = field.lengths[None], field.origin[None]
    points = OPEN.reachable[0]
    assert interpolate(fields, origin, points[50:51, 70])[0] == pytest.approx(field.lengths[50, 70])
    middle = (points[50, 70] + points[50, 71]) / 2
    mean = field.lengths[50, 70:72].mean()
    assert interpolate(fields, origin, middle[None])[0] == pytest.approx(mean)
    assert interpolate(fields, origin, np.array([[99.0, -99.0]]))[0] == field.lengths[0, -1]


@each_case("goal", [None, (math.nan, 0.0, 0.0), (1.0, 0.0, math.inf)])
def test_a_scene_without_a_goal_or_with_one_that_is_no_number_is_refused(goal: tuple[float, ...] | None) -> None:
    with pytest.raises(ConfigError, match="The goal of the arena 'empty' is"):
        Run(None, replace(OPEN, goal=goal))


@pytest.mark.parametrize("goal", [(9.0, 0.0, 0.0), (3.0, 0.0, 0.0)])
def test_a_goal_that_no_way_leads_to_is_refused(goal: tuple[float, float, float]) -> None:
    with pytest.raises(ConfigError, match="No way leads from the start"):
        Run(None, replace(OPEN, goal=goal))
