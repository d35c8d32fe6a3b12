"""The judge, on made-up truth: no simulator, no robot."""

import functools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.arenas import make_arena, random_arena
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.tasks.avoid import TRAIL, AvoidConfig, AvoidTask
from bhd_lerobot.tasks.task import Event
from tests.cases import each_case
from tests.tasks.support import Judged

FPS = 10
made = functools.cache(random_arena)
EMPTY = make_arena("empty", 0)  # 6 m by 6 m, start in the middle


class Run(Judged):
    def __init__(self, config: AvoidConfig, arenas: Sequence = (EMPTY,)) -> None:
        super().__init__(AvoidTask(config, len(arenas), FPS), arenas)
        self.pose = np.array([arena.start for arena in arenas], float)
        self.first = [self.task.outcome(sim, Event.NOTHING).score for sim in range(self.n)]

    def frame(self, positions: np.ndarray, touched: np.ndarray | bool = False) -> np.ndarray:
        """Judge a frame with the robots at these positions [m]."""
        self.pose[:, :2] = positions
        return self.judge(BaseTruth(self.pose.copy(), np.broadcast_to(touched, (self.n,)).copy()))


def on_circle(frame: int, speed: float) -> np.ndarray:
    """A position on a circle of radius 1 m around the middle of the arena, at a speed [m/s]."""
    angle = frame * speed / FPS
    return np.array([[math.sin(angle), 1 - math.cos(angle)]])


@each_case(("speed", "event"), [(0.2, Event.SUCCESS), (0.152, Event.SUCCESS), (0.148, Event.TIMEOUT)])
def test_success_needs_the_whole_time_and_too_short_a_path_is_a_time_out(speed: float, event: Event) -> None:
    run = Run(AvoidConfig(duration_s=20.0))
    for frame in range(1, 201):
        assert run.running[0]
        run.frame(on_circle(frame, speed))
    outcome = run.outcome()
    assert (run.events[0], outcome.success, outcome.event) == (event, event == Event.SUCCESS, event)
    assert run.frames[0] == 200
    assert outcome.details["path_m"] == pytest.approx(20.0 * speed, rel=1e-3)  # chords of arcs


def test_the_path_is_walked_not_the_way_from_the_start() -> None:
    run = Run(AvoidConfig(duration_s=20.0))
    for frame in range(1, 201):
        run.frame(np.array([[0.02 * (frame % 2), 0.0]]))
    assert run.events[0] == Event.SUCCESS
    assert run.outcome().details["path_m"] == pytest.approx(200 * 0.02)


@each_case(("step", "stuck_after"), [(0.0, 100), (0.0009, 100), (0.0011, None)])
def test_less_than_a_tenth_of_a_metre_in_ten_seconds_is_stuck(step: float, stuck_after: int | None) -> None:
    run = Run(AvoidConfig())
    for frame in range(1, 251):
        run.frame(np.array([[step * frame, 0.0]]))
    assert run.events[0] == (Event.STUCK if stuck_after else Event.NOTHING)
    assert run.frames[0] == (stuck_after or 250)


def test_stuck_is_about_the_last_ten_seconds_wherever_they_begin() -> None:
    run = Run(AvoidConfig())
    for frame in range(1, 400):
        moving = min(frame, 137)  # then it stands
        run.frame(on_circle(moving, 0.2))
    # The path of the last 100 frames falls below 0.1 m when all but the last four or five moves are older than that.
    assert run.events[0] == Event.STUCK
    assert 137 + 95 <= run.frames[0] <= 137 + 96


def test_the_last_frame_is_the_end_and_not_stuck() -> None:
    run = Run(AvoidConfig(duration_s=10.0))
    for _ in range(100):
        run.frame(np.array([[0.0, 0.0]]))
    assert run.events[0] == Event.TIMEOUT


@pytest.mark.law
@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.booleans()), min_size=1, max_size=30), st.integers(0, 9)
)
def test_the_score_grows_by_the_rewards_and_stays_a_share(steps: list[tuple[float, float, bool]], seed: int) -> None:
    arena = made(seed)
    run = Run(AvoidConfig(), [arena])
    scores = [run.first[0]]
    for x, y, touched in steps:
        running = run.running[0]
        reward = run.frame(np.array([[x, y]]), touched and bool(x > 2.5))
        scores.append(run.outcome().score)
        assert reward[0] >= 0
        assert scores[-1] - scores[-2] == pytest.approx(reward[0], abs=1e-12)
        if not running:
            assert scores[-1] == scores[-2]
    assert run.first[0] + run.rewards[0] == pytest.approx(scores[-1], abs=1e-12)
    assert min(scores) >= 0
    assert max(scores) <= 1
    free = arena.free_cells(0.25)
    assert run.first[0] == pytest.approx(1 / len(free))  # the start's cell is free and visited
    cells = {int(arena.cell_of(np.array(arena.start[:2]), 0.25))}
    for x, y, touched in steps:
        if touched and x > 2.5:
            break
        inside = arena.extent[0] <= x < arena.extent[1] and arena.extent[2] <= y < arena.extent[3]
        if inside:
            cells.add(int(arena.cell_of(np.array([x, y]), 0.25)))
    assert run.outcome().details["cells_visited"] == len(cells & set(free.tolist()))
    assert run.outcome().details["cells_free"] == len(free)


@each_case("place", [(9.0, 0.0), (-9.0, 0.0), (0.0, 9.0), (0.0, -9.0), (2.99, 3.01), (9.0, 9.0)])
def test_outside_the_arena_is_no_cell(place: tuple[float, float]) -> None:
    run = Run(AvoidConfig())
    run.frame(np.array([place]))
    assert run.rewards[0] == 0
    assert run.outcome().details["cells_visited"] == 1


def trail(task: AvoidTask, pose: np.ndarray) -> np.ndarray:
    """Return the trail as the task reports it, shape (n, bearings, distances)."""
    state = task.environment_state(BaseTruth(pose, np.zeros(len(pose), np.bool_)))
    assert state.shape == (len(pose), len(task.environment_names))
    return state.reshape(len(pose), 16, 8)


def test_the_trail_is_reported_only_on_request() -> None:
    task = AvoidTask(AvoidConfig(), 2, FPS)
    assert task.environment_names == ()
    assert task.environment_state(BaseTruth(np.zeros((2, 3)), np.zeros(2, np.bool_))).shape == (2, 0)
    assert len(set(AvoidTask(AvoidConfig(trail=True), 2, FPS).environment_names)) == len(TRAIL) == 128


@given(st.integers(0, 9), st.integers(0, 2**32 - 1), st.floats(-math.pi, math.pi))
def test_the_trail_agrees_with_the_cells_that_the_score_counts(arena_seed: int, seed: int, yaw: float) -> None:
    arenas = [made(arena_seed), EMPTY]
    run = Run(AvoidConfig(trail=True), arenas)
    rng = np.random.default_rng(seed)
    visited: list[set[int]] = [{int(arena.cell_of(np.array([arena.start[:2]]), 0.25)[0])} for arena in arenas]
    for _ in range(30):
        positions = np.array([rng.uniform(arena.extent[0::2], arena.extent[1::2]) for arena in arenas])
        rewards = run.frame(positions)
        for sim, arena in enumerate(arenas):
            if rewards[sim] > 0:
                visited[sim].add(int(arena.cell_of(positions[sim : sim + 1], 0.25)[0]))
    pose = np.column_stack([positions, [yaw, yaw]])
    seen = trail(run.task, pose)
    for sim, arena in enumerate(arenas):
        for b, bearing in enumerate(yaw + np.radians(22.5) * np.arange(16)):
            points = pose[sim, :2] + 0.25 * np.arange(1, 9)[:, None] * [math.cos(bearing), math.sin(bearing)]
            inside = ((points >= arena.extent[0::2]) & (points < arena.extent[1::2])).all(axis=1)
            cells = arena.cell_of(points, 0.25)
            expected = [bool(i) and int(c) in visited[sim] for i, c in zip(inside, cells, strict=True)]
            # Two ways to add up a place may differ where it lies on the edge of a cell.
            edge = np.abs((points - arena.extent[0::2]) / 0.25 % 1 - 0.5).max(axis=1) > 0.5 - 1e-9
            assert ((seen[sim, b] == expected) | edge).all()


def test_a_duration_in_which_no_episode_can_succeed_is_noted() -> None:
    body = turtlebot3_burger()
    for duration_s, notes in ((10.0, 1), (13.0, 1), (14.0, 0), (60.0, 0)):  # 3 m at 0.22 m/s take 13.6 s
        assert len(AvoidTask(AvoidConfig(duration_s=duration_s), 1, 10, body).notes) == notes
    assert not AvoidTask(AvoidConfig(duration_s=10.0, min_path_m=2.0), 1, 10, body).notes
