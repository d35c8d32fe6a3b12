"""From setpoints to a reference: whatever the setpoints are, every limit holds at every tick."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.setpoints import follow_setpoint, leave_setpoints, take_setpoint
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.messages import Limit
from tests.control.arm_rig import ARM, FRAME, HOME, HZ, LIMITS, off

LOWER, UPPER = np.array(LIMITS.lower), np.array(LIMITS.upper)
SPEED, ACCELERATION = np.array(LIMITS.velocity), np.array(LIMITS.acceleration)
SLACK = 1e-9


class Stream:
    """Setpoints for n arms, and the reference that follows them, with all that it did before."""

    def __init__(self, n: int = 1, start: np.ndarray = HOME, frame: int = FRAME) -> None:
        self.n, self.frame_ticks = n, frame
        self.controller = controller = ArmController(ARM, n, HZ, frame, holds=False, keeps_clear=False)
        self.position, self.velocity = controller.command, controller.velocity
        self.acceleration, self.limits = controller.acceleration, controller.limits
        self.position[:] = start
        [self._limits] = as_objects(controller.arm_limits)
        self._records = list(zip(as_objects(controller.states), as_objects(controller.arms), strict=True))
        self.rows: list[np.ndarray] = [np.stack([self.position, self.velocity, self.acceleration])]

    def run(self) -> None:
        for state, arm in self._records:
            if arm.follows_setpoints:
                follow_setpoint(state, arm, self._limits, None)

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.run()
            self.rows.append(np.stack([self.position, self.velocity, self.acceleration]))

    def check(self) -> None:
        p, v, a = np.moveaxis(np.array(self.rows), 1, 0)
        assert np.isfinite(self.rows).all()
        assert (p - UPPER).max() <= SLACK
        assert (LOWER - p).max() <= SLACK
        assert (np.abs(v) - SPEED).max() <= SLACK
        assert (np.abs(a) - ACCELERATION).max() <= SLACK
        assert (np.abs(np.diff(a, axis=0)) * HZ - np.array(LIMITS.setpoint_jerk)).max() <= HZ * SLACK
        assert np.allclose(np.diff(v, axis=0), a[1:] / HZ, atol=1e-12)
        assert np.allclose(np.diff(p, axis=0), v[1:] / HZ, atol=1e-12)

    @property
    def history(self) -> np.ndarray:
        """Positions at each tick, shape (ticks, n, 7)."""
        return np.array(self.rows)[:, 0]

    def set_setpoint(self, values: np.ndarray, mask: np.ndarray | None = None) -> None:
        self.controller.states["requested"][:, :7] = values
        for sim, (state, arm) in enumerate(self._records):
            if mask is None or mask[sim]:
                take_setpoint(state, arm, self._limits)

    def drop(self) -> None:
        leave_setpoints(self._records[0][1])

    def frame(self, values: np.ndarray, frames: int = 1) -> None:
        for _ in range(frames):
            self.set_setpoint(values)
            self.tick(self.frame_ticks)


wild = st.lists(
    st.tuples(
        st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7),  # share of the range; beyond 1 is outside
        st.integers(1, 45),  # ticks until the next one: early, on time, late
        st.sampled_from(["all", "first", "none", "repeat"]),
    ),
    min_size=1,
    max_size=12,
)


@settings(max_examples=40)
@given(wild, st.integers(1, 40))
def test_no_stream_of_setpoints_breaks_a_limit(script: list, frame: int) -> None:
    stream = Stream(2, frame=frame)
    middle, half = (UPPER + LOWER) / 2, (UPPER - LOWER) / 2
    values = HOME
    for shares, ticks, kind in script:
        values = values if kind == "repeat" else middle + half * np.array(shares)
        if kind != "none":
            stream.set_setpoint(values, np.array([True, kind != "first"]))
        stream.tick(ticks)
    stream.tick(200)
    stream.check()


@pytest.mark.law
@settings(max_examples=5)
@given(st.integers(0, 2**32 - 1))
def test_no_jitter_near_the_ends_of_the_range_breaks_a_limit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (4, 7)
    stream = Stream(shape[0], start=np.where(rng.random(shape) < 0.5, LOWER, UPPER))
    for _ in range(20):
        stream.frame(np.where(rng.random(shape) < 0.5, LOWER, UPPER) + rng.normal(0, 0.02, shape))
    stream.check()


@pytest.mark.parametrize("value", [1e9, -1e9, 1e300, -1e300])
def test_setpoints_from_another_world_lead_to_the_end_of_the_range(value: float) -> None:
    stream = Stream()
    stream.frame(np.full(7, value), 150)
    assert np.allclose(stream.position, UPPER if value > 0 else LOWER, atol=1e-6)
    assert np.abs(stream.velocity).max() < 1e-3
    stream.check()


@pytest.mark.parametrize("speed", [0.1, 0.5, -1.0, 2.5])
def test_a_steady_motion_is_followed_without_a_lag(speed: float) -> None:
    stream = Stream()
    setpoint = HOME.copy()
    for frame in range(40):
        setpoint[:6] += speed * FRAME / HZ / 2
        stream.frame(setpoint)
        if frame > 30:
            # A tick's worth is what the grid of ticks leaves open.
            assert np.abs(stream.position[0, :6] - setpoint[:6]).max() <= abs(speed) / 2 / HZ + 1e-6
            assert np.allclose(stream.velocity[0, :6], speed / 2, atol=1e-6)


@pytest.mark.parametrize("change", [0.0, 1e-4, 0.01, -0.3, 2.0])
def test_a_setpoint_that_stays_is_reached_exactly_and_passed_by_a_braking_distance_at_most(change: float) -> None:
    stream = Stream()
    goal = off(j0=change, j4=-change, j6=-abs(change) / 100)
    stream.frame(goal, 75)
    assert np.allclose(stream.position, goal, atol=1e-9)
    assert np.allclose(stream.velocity, 0, atol=1e-7)
    # The stream might have gone on: a target that moves evenly to where it ends is not slowed down for.
    fastest = np.minimum(np.abs(goal - HOME) * HZ / FRAME, SPEED) * 1.5
    beyond = ((stream.history[:, 0] - goal) * np.sign(goal - HOME)).max(axis=0)
    assert (beyond <= fastest**2 / (2 * ACCELERATION) + fastest / HZ + 1e-12).all()
    assert beyond.max() <= 0.01
    stream.check()


def test_after_a_moving_stream_the_last_setpoint_is_reached_exactly_too() -> None:
    stream = Stream()
    for frame in range(20):
        stream.frame(off(j1=0.03 * (frame + 1)))
    stream.tick(1000)  # no setpoint any more: the last one counts
    assert np.allclose(stream.position, off(j1=0.6), atol=1e-9)


def test_a_range_s_ends_are_inside() -> None:
    stream = Stream(2)
    stream.set_setpoint(np.stack([LOWER, UPPER]))
    assert stream.limits.tolist() == [Limit.NONE, Limit.NONE]
    stream.set_setpoint(np.stack([np.nextafter(LOWER, -10), HOME]))
    assert stream.limits.tolist() == [Limit.POSITION, Limit.NONE]


def test_dropped_setpoints_are_not_followed_and_the_next_start_from_the_reference() -> None:
    stream = Stream()
    stream.frame(off(j0=1.0), 5)
    stream.drop()
    before = stream.position.copy()
    stream.run()
    assert np.array_equal(stream.position, before)
    stream.velocity[:] = 0  # it was brought to rest elsewhere by other means
    stream.position[:] = HOME
    stream.rows.clear()
    stream.frame(off(j0=0.001), 50)
    assert np.abs(stream.history[:, 0, 0] - HOME[0]).max() < 0.0011


def test_setpoints_that_come_more_often_than_frames_are_followed_too() -> None:
    stream = Stream()
    for step in range(400):
        stream.set_setpoint(off(j0=0.001 * (step + 1)))
        stream.tick(1)
    # Each setpoint would take a frame; the newest counts, so the reference is at most that frame behind.
    assert stream.position[0, 0] - HOME[0] == pytest.approx(0.4, abs=0.001 * (FRAME + 1))
