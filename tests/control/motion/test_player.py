"""What a trajectory is going to be, and rows that are played where they lie. How it plays: see test_trajectory."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.motion.player import TrajectoryPlayer
from bhd_lerobot.control.motion.trajectory import State, Trajectory


def rows_of(ticks: int, seed: int = 0, dof: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(ticks, 3, dof))


def trajectory(rows: np.ndarray) -> Trajectory:
    return Trajectory(rows[:, 0], rows[:, 1], rows[:, 2])


def play(player: TrajectoryPlayer, n: int = 1) -> np.ndarray:
    reference = np.full((3, n, 2), np.nan)
    player.tick(*reference)
    return reference


def equal(state: State | None, row: np.ndarray) -> bool:
    return state is not None and np.array_equal((state.position, state.velocity, state.acceleration), row)


@given(st.integers(1, 20), st.integers(0, 19), st.integers(1, 30), st.booleans())
def test_ahead_matches_later_playback(ticks: int, played: int, ahead: int, borrowed: bool) -> None:
    player, rows = TrajectoryPlayer(1, 2), rows_of(ticks)
    player.start(0, trajectory(rows_of(5, 1)))
    play(player)
    if borrowed:
        player.borrow(rows)
    else:
        player.start(0, trajectory(rows))
    for _ in range(played):
        play(player)
    if played >= ticks:
        assert player.ahead(0, ahead) is None
        assert not player.active[0]
        return
    state = player.ahead(0, ahead)
    assert equal(state, rows[min(played + ahead, ticks) - 1])
    last = play(player)
    for _ in range(min(ahead, ticks - played) - 1):
        last = play(player)
    assert equal(state, last[:, 0])


def test_borrowed_rows_are_played_where_they_lie() -> None:
    player, rows = TrajectoryPlayer(1, 2), rows_of(6)
    player.borrow(rows)
    state = player.ahead(0, 2)
    assert state is not None
    state.position[:] = 9.0  # of a copy
    assert (rows != 9.0).all()
    assert player.remaining(0) == 6
    assert np.array_equal(play(player)[:, 0], rows[0])
    rows[1] = 7.0  # forbidden to the owner; that it shows proves that nothing was copied
    assert (play(player) == 7.0).all()
    player.stop(0)
    assert np.isnan(play(player)).all()
    assert player.remaining(0) == 0
    with pytest.raises(ValueError, match="3 simulations"):
        TrajectoryPlayer(3, 2).borrow(rows_of(2))
