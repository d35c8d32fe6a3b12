"""What both brains that drive along free paths do: limits, walls, blindness, independence of n, what they refuse."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import MAX_ANGULAR, MAX_LINEAR, WHEEL_SEPARATION, turtlebot3_burger
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.policies.navigation.navigator import GOAL, NavigatorBrain
from tests.cases import each_case

BURGER = turtlebot3_burger()
ACTIONS = ("x.vel", "theta.vel")
AHEAD = np.array([[2.0, 0.0, 1.0, 0.0]])  # a goal: x, y, and the cosine and sine of its heading
BRAINS = (GapFollowerBrain, NavigatorBrain)


def names_of(beams: int) -> tuple[str, ...]:
    return ("x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(beams)))


def bound(kind: Any, n: int = 1, beams: int = 360, config: Any = None, body: Any = BURGER) -> Any:
    brain = kind(config)
    brain.bind(RobotFeatures(names_of(beams), ACTIONS, 10, GOAL, body=body))
    brain.reset(np.arange(n), [0] * n, n)
    return brain


def see(brain: Any, scan: np.ndarray, twist: tuple[float, float] = (0.0, 0.0), goal: np.ndarray = AHEAD) -> np.ndarray:
    """Let robots see scans, shape (n, beams), which nothing may write to."""
    scan = np.atleast_2d(scan)
    state = np.hstack([np.tile(twist, (len(scan), 1)), scan])
    state.flags.writeable = False
    told = np.broadcast_to(goal, (len(scan), 4))
    return brain.act(Observation(names_of(scan.shape[1]), state, environment_state=told))


def inside_box(beams: int, front: float, back: float, left: float, right: float) -> np.ndarray:
    """Return the scan of a robot in a rectangle, distances from the range finder."""
    angle = 2 * np.pi * np.arange(beams) / beams
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(angle) > 0, front, back) / np.abs(np.cos(angle))
        y = np.where(np.sin(angle) > 0, left, right) / np.abs(np.sin(angle))
    return np.clip(np.minimum(x, y), 0.12, 3.5)


def random_scans(n: int, beams: int = 360, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    scale = rng.choice([0.3, 1.0, 3.5], (n, 1))
    smooth = np.cumsum(rng.normal(0, 0.1, (n, beams)), axis=1)
    return np.clip(scale * (0.6 + smooth / 2), 0.12, 3.5)


def random_goals(n: int, farthest: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    yaw = rng.uniform(-3, 3, n)
    return np.column_stack([rng.uniform(-farthest, farthest, (n, 2)), np.cos(yaw), np.sin(yaw)])


@each_case("kind", BRAINS)
def test_it_never_asks_for_more_than_the_robot_can(kind: Any) -> None:
    scan = np.vstack([random_scans(100, seed=1), np.full((1, 360), 0.12), np.full((1, 360), 3.5)])
    brain, rim = bound(kind, len(scan)), MAX_ANGULAR * WHEEL_SEPARATION / 2
    for step in range(3):
        action = see(brain, np.roll(scan, 40 * step, axis=1), (0.2, 0.3), random_goals(len(scan), 20.0))
        assert np.isfinite(action).all()
        assert (np.abs(action) <= (MAX_LINEAR, MAX_ANGULAR)).all()
        assert (np.abs(action[:, 0]) + np.abs(action[:, 1]) * WHEEL_SEPARATION / 2 <= rim + 1e-9).all()


@pytest.mark.law
@each_case("kind", BRAINS)
@each_case("beams", [36, 360])
@each_case("distance", [0.12, 0.2])
def test_it_does_not_drive_into_a_wall(kind: Any, beams: int, distance: float) -> None:
    for back, side in ((3.0, 1.0), (distance, distance)):
        scan = inside_box(beams, front=distance, back=back, left=side, right=side)
        assert see(bound(kind, 1, beams), scan)[0, 0] <= 0


@pytest.mark.law
@each_case("kind", BRAINS)
@each_case("blind", [np.nan, np.inf, -np.inf, 0.0, 0.11, 3.6])
def test_blind_it_stops_and_sees_again(kind: Any, blind: float) -> None:
    brain, scan = bound(kind, 2, 90), np.full((2, 90), 3.5)
    scan[0] = blind
    action = see(brain, scan)
    assert action[0].tolist() == [0, 0]
    assert action[1, 0] > 0.19
    scan[0] = 3.5
    assert (see(brain, scan)[:, 0] > 0.19).all()


@each_case("kind", BRAINS)
def test_many_robots_decide_like_each_alone_to_the_last_bit(kind: Any) -> None:
    n, goals = 5, random_goals(5, 3.0)
    scans = [random_scans(n, seed=seed) for seed in range(6)]

    def drive(ids: list[int]) -> np.ndarray:
        brain = bound(kind, len(ids))
        return np.array([see(brain, scan[ids], (0.1, 0.2), goals[ids]) for scan in scans])

    together = drive(list(range(n)))
    for sim in range(n):
        assert drive([sim])[:, 0].tobytes() == together[:, sim].tobytes()


@each_case("kind", BRAINS)
def test_a_robot_that_it_cannot_drive_is_refused(kind: Any) -> None:
    with pytest.raises(ConfigError, match="was reset for 2 robots and sees 3"):
        see(bound(kind, 2, 90), np.full((3, 90), 1.0))
    with pytest.raises(ConfigError, match="needs at least 36 beams; this robot has 30"):
        bound(kind, 1, 30)
    for names, missing in (
        (names_of(0), "needs a range scan"),
        (("x.vel", *names_of(90)[2:]), r"needs the observation feature\(s\) theta\.vel"),
    ):
        with pytest.raises(ConfigError, match=missing):
            kind().bind(RobotFeatures(names, ACTIONS, 10, GOAL, body=BURGER))
