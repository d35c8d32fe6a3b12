"""The streams of mad brains, a few of them: what `python -m benchmarks.wire` runs a thousand of."""

from typing import Any

import numpy as np
import pytest

from benchmarks import wire
from bhd_lerobot.control import kernels, tick


@pytest.mark.thorough
@pytest.mark.parametrize("space", wire.SPACES)
def test_nothing_unsafe_is_written(space: str) -> None:
    with np.errstate(all="ignore"):
        plain, vandalised = wire.run(space, len(wire.KINDS), 16, 1)
    assert plain.writes == vandalised.writes > 0
    assert plain.unsafe == vandalised.unsafe == 0
    assert vandalised.faults > 0  # the guard had something to do, and the robots went on after a reset


@pytest.mark.thorough
@pytest.mark.parametrize("space", ["wheels", wire.MOBILE])
def test_whatever_is_read_a_stop_is_followed_by_no_more_motion_than_it_needs(space: str) -> None:
    """Of an arm alone it is in `tests/robots/test_false_readings.py`."""
    for lie in wire.LIES:
        one = wire.deceive(space, lie, 12, 50, 1)
        assert one.unsafe == 0
        assert one.is_short(space, lie)
        assert one.faster < wire.FASTER or space == "wheels"
        assert one.stopped or (space, lie) in {("wheels", "drifting"), ("wheels", "counting twice")}


def test_the_judge_is_not_blind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the guard, the same streams write what is not safe."""

    def let_through(state: Any, limits: Any) -> bool:
        state.written[:] = state.actuators
        return True

    monkeypatch.setattr(tick, "guard", let_through)
    with np.errstate(all="ignore"), kernels.plain_python():
        _, vandalised = wire.run("joints", len(wire.KINDS), 8, 1)
    assert vandalised.unsafe > 0
