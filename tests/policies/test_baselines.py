"""Doing nothing and moving at random, on both robots."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.baselines import NoopBrain, RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from tests.cases import each_case

BASE = turtlebot3_burger().limits.names
ARM = ur5().limits.names


def actions(brain: Any, names: tuple[str, ...], frames: int, seeds: list[int], fps: int = 10) -> np.ndarray:
    """Return what a brain wants when the robots stand at 0.5, 1.5, …, shape (frames, n, actions)."""
    n = len(seeds)
    body = next((one for one in (turtlebot3_burger(), ur5()) if one.limits.names == names), None)
    brain.bind(RobotFeatures(("other", *names), names, fps, (), body))
    brain.reset(np.arange(n), seeds, n)
    state = np.tile(0.01 * np.arange(n)[:, None], (1, len(names) + 1))
    return np.array([brain.act(Observation(("other", *names), state + 0.001 * frame)) for frame in range(frames)])


def test_nothing_is_no_speed_and_the_positions_of_the_beginning() -> None:
    assert np.array_equal(actions(NoopBrain(), BASE, 3, [0, 1]), np.zeros((3, 2, 2)))
    held = actions(NoopBrain(), ARM, 3, [0, 1])
    assert np.array_equal(held, np.tile(np.array([0.0, 0.01])[:, None], (3, 1, 7)))


def test_a_new_episode_is_held_where_it_begins() -> None:
    brain = NoopBrain()
    actions(brain, ARM, 2, [0, 1])
    brain.reset(np.array([1]), [5], 2)
    held = brain.act(Observation(("other", *ARM), np.ones((2, 8)), running=np.array([True, False])))
    assert held[0] == pytest.approx(0)
    assert held[1] == pytest.approx(0.01)  # not observed before it runs
    assert brain.act(Observation(("other", *ARM), np.ones((2, 8))))[1] == pytest.approx(1)


@each_case("names", [BASE, ARM])
@each_case(("period", "scale"), [(0, 1), (0.7, 1), (0.7, 0.25)])
def test_random_actions_stay_within_the_limits(names: tuple[str, ...], period: float, scale: float) -> None:
    limits: Any = turtlebot3_burger().limits if names == BASE else ur5().limits
    upper = np.array(limits.upper if names == ARM else limits.velocity)
    lower = np.array(limits.lower) if names == ARM else -upper
    wanted = actions(RandomBrain(RandomConfig(period, scale)), names, 200, [1, 2, 3])
    assert (wanted >= lower - 1e-9).all()
    assert (wanted <= upper + 1e-9).all()
    half = scale * (upper - lower) / 2
    used = np.abs(wanted - (0.01 * np.arange(3)[:, None] if names == ARM else 0)).max((0, 1))
    assert (used <= half + 1e-9).all()
    assert (used > 0.5 * half).all()


def test_between_two_random_actions_it_goes_in_a_straight_line() -> None:
    smooth = actions(RandomBrain(RandomConfig(period_s=0.5)), BASE, 31, [4])[:, 0]
    steps = np.diff(np.concatenate([np.zeros((1, 2)), smooth]), axis=0)[:30].reshape(6, 5, 2)
    assert steps == pytest.approx(np.repeat(steps[:, :1], 5, axis=1))
    assert len(np.unique(steps[:, 0, 0])) == 6


def test_random_actions_follow_from_the_seed_alone() -> None:
    three = actions(RandomBrain(), BASE, 20, [1, 2, 3])
    assert np.array_equal(three[:, 1], actions(RandomBrain(), BASE, 20, [2])[:, 0])
    assert not np.array_equal(three[:, 0], three[:, 1])


def test_what_they_cannot_do_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"hold the action 'grip\.force'"):
        NoopBrain().bind(RobotFeatures(("a.pos",), ("grip.force",), 10))
    with pytest.raises(ConfigError, match=r"tool_x\.pos"):
        NoopBrain().bind(RobotFeatures(("a.pos",), ("tool_x.pos",), 10))
    with pytest.raises(ConfigError, match=r"knows no range for the actions x\.vel"):
        RandomBrain().bind(RobotFeatures(("x.vel",), ("x.vel",), 10))
