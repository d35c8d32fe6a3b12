"""Whatever is asked for, the guard's own answers keep the limits of the wire, to the end of a range and back."""

import numpy as np
import pytest

from bhd_lerobot.control import kernels
from bhd_lerobot.control.guard import guard
from bhd_lerobot.control.record import LIMITS, new_states, put

TICKS, RANGE, CHANGE = 400, 1.0, 0.04


@pytest.mark.law
@pytest.mark.parametrize("bend", [0.001, 0.0037, 0.04, np.inf])
@pytest.mark.parametrize("seed", range(4))
def test_no_stream_of_commands_brings_the_wire_beyond_its_limits(bend: float, seed: int) -> None:
    """The stream is the fastest that each tick lets through, with jumps and numbers that are none now and then."""
    rng = np.random.default_rng(seed)
    states, numbers = new_states(1), np.zeros(1, LIMITS)
    numbers["joints"] = 2
    for name, most in (("lower", -RANGE), ("upper", RANGE), ("change", CHANGE), ("bend", bend)):
        put(numbers, name, np.full((1, 2), most))
    [state], [limits] = kernels.as_objects(states), kernels.as_objects(numbers)
    written, kept = np.zeros((TICKS, 2)), np.zeros(TICKS, np.bool_)
    towards = np.ones(2)
    for tick in range(TICKS):
        towards = np.where(rng.random(2) < 0.02, -towards, towards)
        fastest = np.clip(state.written_rate[:2] + towards * min(bend, CHANGE), -CHANGE, CHANGE)
        state.position[:2] = -np.sign(fastest) * 10.0  # from which the command leads away
        state.actuators[:2] = state.written[:2] + fastest * (1.0 - 1e-9)
        if rng.random() < 0.02:
            state.actuators[rng.integers(2)] = rng.choice([np.nan, np.inf, 3.0, -0.5])
        kept[tick] = guard(state, limits)
        written[tick] = state.written[:2]
    assert np.abs(written).max() <= RANGE
    assert 0.1 < kept.mean() < 1.0
    changes = np.diff(written, axis=0)
    assert np.abs(changes).max() <= CHANGE * (1 + 1e-9)
    if bend < CHANGE:  # an end that is met within a tick is no end of a motion, but of a range
        assert np.abs(np.diff(changes, axis=0)).max() <= bend * (1 + 1e-9)
