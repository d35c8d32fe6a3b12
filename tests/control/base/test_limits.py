import numpy as np
import pytest
from bhd_lerobot.control.base import limits
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

N = 5
ANY = st.floats(-1e6, 1e6) | st.floats(-3, 3) | st.sampled_from([0.0, -0.0, 0.22, 2.84, 1e300, -1e300])
COMMANDS = arrays(np.float64, (N, 2), elements=ANY)
NEAR = arrays(np.float64, (N, 2), elements=st.floats(-3, 3))
LIMITS = arrays(np.float64, (2,), elements=st.floats(1e-3, 10))
PER_SPEED, PER_YAW, WHEEL_LIMIT = 1 / 0.033, 0.08 / 0.033, 6.9


@given(requested=COMMANDS, limit=LIMITS)
def test_velocity(requested: np.ndarray, limit: np.ndarray) -> None:
    before = requested.copy()
    out, changed = np.empty_like(requested), np.zeros((N, 2), np.bool_)
    limits.limit_velocity(requested, limit, out, changed)
    np.testing.assert_array_equal(requested, before)
    assert (np.abs(out) <= limit).all()
    np.testing.assert_array_equal(changed, np.abs(requested) > limit)  # flagged if and only if it had to change
    np.testing.assert_array_equal(out[~changed], requested[~changed])
    np.testing.assert_array_equal(np.sign(out), np.sign(requested))
    again, changed_again = np.empty_like(out), np.zeros((N, 2), np.bool_)
    limits.limit_velocity(out, limit, again, changed_again)
    assert again.tobytes() == out.tobytes()
    assert not changed_again.any()


@pytest.mark.law
@given(requested=NEAR, previous=NEAR, largest=arrays(np.float64, (N, 2), elements=st.floats(1e-3, 1)))
def test_change(requested: np.ndarray, previous: np.ndarray, largest: np.ndarray) -> None:
    out, changed = np.empty_like(requested), np.zeros((N, 2), np.bool_)
    arrived = limits.limit_change(requested, previous, largest, out, changed)
    assert (np.abs(out - previous) <= largest * (1 + 1e-12) + 1e-15).all()
    assert ((out - previous) * (requested - previous) >= 0).all()  # towards what was asked for,
    assert (np.abs(out - previous) <= np.abs(requested - previous) + 1e-15).all()  # and not past it
    np.testing.assert_array_equal(out[~changed], requested[~changed])
    np.testing.assert_array_equal(changed, np.abs(requested - previous) > largest)
    assert arrived == (not changed.any())
    # In place of the previous command, as the cerebellum has it.
    in_place = previous.copy()
    limits.limit_change(requested, in_place, largest, in_place, np.zeros((N, 2), np.bool_))
    assert in_place.tobytes() == out.tobytes()


@settings(max_examples=50)
@given(requested=NEAR, start=NEAR, largest=arrays(np.float64, (N, 2), elements=st.floats(0.05, 1)))
def test_change_arrives_exactly_after_the_ticks_that_it_takes(
    requested: np.ndarray, start: np.ndarray, largest: np.ndarray
) -> None:
    command, changed = start.copy(), np.zeros((N, 2), np.bool_)
    ticks = 1 + int(np.ceil((np.abs(requested - start) / largest).max()))
    for _ in range(ticks):
        arrived = limits.limit_change(requested, command, largest, command, changed)
    assert arrived
    assert command.tobytes() == requested.tobytes()


@settings(max_examples=25)
@given(
    targets=arrays(np.float64, (6, N, 2), elements=st.sampled_from([-0.3, 0.0, 0.3]) | st.floats(-0.3, 0.3)),
    ticks=st.integers(1, 60),
    jerk=arrays(np.float64, (2,), elements=st.floats(1e-4, 1e-2)),
    largest=arrays(np.float64, (2,), elements=st.floats(1e-3, 0.05)),
)
def test_jerk(targets: np.ndarray, ticks: int, jerk: np.ndarray, largest: np.ndarray) -> None:
    command, rate, flags = np.zeros((N, 2)), np.zeros((N, 2)), np.zeros((N, 2), np.bool_)
    seen = [command.copy(), command.copy()]
    for target in targets:
        for _ in range(ticks):
            limits.limit_jerk(target, command, rate, largest=largest, jerk=jerk, out=command, changed=flags)
            seen.append(command.copy())
    changes = np.diff(seen, axis=0)
    assert (np.abs(seen) <= 0.3 * (1 + 1e-9)).all()  # never past the farthest of all targets
    assert (np.abs(changes) <= largest * (1 + 1e-9) + 1e-12).all()
    assert (np.abs(np.diff(changes, axis=0)) <= jerk * (1 + 1e-9) + 2e-12).all()
    # What stays is reached exactly, in time, and not passed once it is approached.
    for _ in range(10 + int((0.7 / np.minimum(largest, 10) + 2 * largest / jerk + 3 * np.sqrt(0.7 / jerk)).max())):
        arrived = limits.limit_jerk(target, command, rate, largest=largest, jerk=jerk, out=command, changed=flags)
    assert arrived.all()
    assert command.tobytes() == target.tobytes()
    assert not rate.any()
    start = np.zeros((N, 2))
    last, rate = start.copy(), np.zeros((N, 2))
    for _ in range(200):
        before = last.copy()
        limits.limit_jerk(target, last, rate, largest=largest, jerk=jerk, out=last, changed=flags)
        assert ((last - before) * np.sign(target) >= 0).all()
        assert (np.abs(last) <= np.abs(target)).all()


@pytest.mark.law
@given(twist=arrays(np.float64, (N, 2), elements=st.floats(-10, 10)))
def test_wheel_speed(twist: np.ndarray) -> None:
    limited, changed = twist.copy(), np.zeros(N, np.bool_)
    any_limited = limits.limit_wheel_speed(limited, PER_SPEED, PER_YAW, WHEEL_LIMIT, changed)
    np.testing.assert_array_equal(limited[:, 1], twist[:, 1])  # turning is unchanged
    fastest = np.abs(limited[:, 0]) * PER_SPEED + np.abs(limited[:, 1]) * PER_YAW
    possible = np.abs(twist[:, 1]) * PER_YAW <= WHEEL_LIMIT
    assert (fastest[possible] <= WHEEL_LIMIT * (1 + 1e-9)).all()
    assert (limited[~possible, 0] == 0).all()
    assert (np.abs(limited[:, 0]) <= np.abs(twist[:, 0])).all()
    assert (limited[:, 0] * twist[:, 0] >= 0).all()
    np.testing.assert_array_equal(changed, limited[:, 0] != twist[:, 0])
    assert any_limited == changed.any()
    # No more is taken away than has to be.
    held = changed & possible
    np.testing.assert_allclose(fastest[held], WHEEL_LIMIT, rtol=1e-9)
    again, changed_again = limited.copy(), np.zeros(N, np.bool_)
    assert not limits.limit_wheel_speed(again, PER_SPEED, PER_YAW, WHEEL_LIMIT, changed_again)
    assert again.tobytes() == limited.tobytes()


@given(requested=COMMANDS, limit=LIMITS)
def test_flags_accumulate_until_taken(requested: np.ndarray, limit: np.ndarray) -> None:
    everything = np.ones((N, 2), np.bool_)
    limits.limit_velocity(requested, limit, np.empty_like(requested), everything)
    limits.limit_change(requested, requested.copy(), np.ones((N, 2)), np.empty_like(requested), everything)
    assert everything.all()
    one = np.ones(N, np.bool_)
    limits.limit_wheel_speed(np.zeros((N, 2)), PER_SPEED, PER_YAW, WHEEL_LIMIT, one)
    assert one.all()
