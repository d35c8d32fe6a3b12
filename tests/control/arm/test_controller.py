"""An arm under the cerebellum, on a virtual clock: goals, setpoints, stops, and no jump at any of their edges."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Mode, Reason, Request, Watchdog
from bhd_lerobot.control.plant import PlantReading
from tests.control.arm_rig import FRAME, HOME, HZ, LIMITS, SWEEP, TICK_NS, TIMEOUT_TICKS, Rig, off, posture


def test_a_goal_is_tracked_and_then_held() -> None:
    rig = Rig()
    assert rig.mode == Mode.HOLD
    assert rig.go(**SWEEP) is None
    rig.tick()
    assert rig.mode == Mode.TRACKING
    rig.until(Mode.HOLD)
    assert rig.results() == [("1", ResultCode.SUCCEEDED)]
    modes = [row[0] for row in rig.modes]
    assert set(modes) == {Mode.TRACKING, Mode.HOLD}
    assert modes == sorted(modes, reverse=True)  # tracking first, and never again
    rig.tick(50)
    assert np.allclose(rig.plant.position[0], [*posture(j0=0.8), 0.03], atol=2e-3)
    assert rig.results() == []
    rig.check()


def test_goals_that_wait_follow_each_other_without_a_hold_between() -> None:
    rig = Rig()
    for change in (0.3, -0.3, 0.1):
        rig.go(joint_target=posture(j0=change))
    rig.tick()
    rig.until(Mode.HOLD)
    assert rig.results() == [(name, ResultCode.SUCCEEDED) for name in ("1", "2", "3")]
    assert [row[0] for row in rig.modes].count(Mode.HOLD) == 1
    rig.check()


def test_a_moving_arm_is_where_it_is_commanded() -> None:
    """The lead makes up for the servos' damping: without it, an arm at 1 rad/s would be 10 to 20 mrad late."""
    rig = Rig()
    values = HOME.copy()
    for frame in range(40):
        values[:6] += 1.0 * FRAME / HZ * (frame < 35)
        rig.stream(values, 1)
        if 20 < frame < 35:
            assert np.abs(rig.plant.position - rig.cerebellum.command)[:, :6].max() < 2.1e-3  # a tick
    rig.check()


def leave(rig: Rig, how: str, rng: np.random.Generator) -> None:
    if how == "emergency stop":
        rig.cerebellum.estop.press()
    elif how == "goal":
        rig.go(joint_target=posture(j0=float(rng.uniform(-1, 1))))
    elif how == "deactivation":
        rig.request(Request.DEACTIVATE)
    elif how == "not finite":
        rig.cerebellum.fifo.push(10**6, rig.now, np.full((1, 7), np.nan), np.ones(1, np.bool_))
    elif how != "silence":
        rig.cerebellum.interrupt(Watchdog.BRAIN, Mode.STOPPING)
        rig.tick(int(rng.integers(1, 30)))
        rig.send(HOME)


@pytest.mark.thorough(but=6)
@pytest.mark.parametrize(
    "how", ["silence", "emergency stop", "goal", "deactivation", "not finite", "a stop and setpoints again"]
)
@pytest.mark.parametrize("seeds", [range(6), range(6, 30)], ids=str)
def test_whatever_ends_a_stream_of_setpoints_bends_the_reference_no_more_than_the_stream(
    how: str, seeds: range
) -> None:
    for seed in seeds:
        rng, rig = np.random.default_rng(seed), Rig()
        values, rate = HOME.copy(), rng.uniform(0.1, 1.0)
        for frame in range(int(rng.integers(3, 25))):
            if seed % 3 == 0 and frame % 4 == 0:
                values = HOME + rng.uniform(-1, 1, 7) * (1, 1, 1, 1, 1, 1, 0.03)
            elif seed % 3 == 1:
                values = values + rng.uniform(0, 0.13, 7) * (1, 1, 1, 1, 1, 1, 0.01)
            elif seed % 3 == 2:
                values = HOME + np.array([1, 0.5, 0.5, 1, 1, 1, -0.02]) * np.sin(frame * rate)
            rig.send(values)
            rig.tick(FRAME)
        rig.send(values + np.array([0.05] * 6 + [-0.005]))
        rig.tick(int(rng.integers(0, FRAME)))
        leave(rig, how, rng)
        rig.tick(60)
        rows = np.array(rig.rows)[:, 0]
        jerk = np.abs(np.diff(rows, n=3, axis=0)) * HZ**3
        assert (jerk <= np.array(LIMITS.setpoint_jerk) * 1.05).all(), seed
        assert (np.abs(np.diff(rows, axis=0)) * HZ <= np.array(LIMITS.velocity) * 1.001).all(), seed


@pytest.mark.law
def test_without_setpoints_the_arm_stops_at_the_time_out_and_holds() -> None:
    rig = Rig()
    values = HOME.copy()
    for _ in range(20):
        values[0] += 0.03
        rig.stream(values, 1)
    last = rig.now - FRAME * TICK_NS
    rig.until(Mode.STOPPING)
    stale = (rig.now - TICK_NS - last) / NANOSECONDS  # the tick that stopped it
    assert LIMITS.command_timeout_s < stale <= LIMITS.command_timeout_s + 1 / HZ
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.COMMAND_AGE]
    rig.until(Mode.HOLD)
    rig.tick(5)
    assert np.array_equal(rig.rows[-1], rig.rows[-2])
    rig.check()


@pytest.mark.law
@pytest.mark.parametrize("step", [0.2, 0.5])
@pytest.mark.parametrize("frames", [1, 3])
def test_a_stream_that_falls_silent_on_its_way_to_the_end_of_a_range_comes_to_rest_within_it(
    step: float, frames: int
) -> None:
    """Wherever it does: a joint that still speeds up may have no room for a gentle brake."""
    rig, joints = Rig(24, active=False), [0, 5]
    rig.plant.position[:, joints] = np.subtract(2 * np.pi, np.linspace(0.05, 0.6, 24))[:, None]
    for request in (Request.CONFIGURE, Request.ACTIVATE):
        assert rig.request(request).accepted.all()
    rig.rows, values = [rig.cerebellum.command.copy()], rig.plant.position.copy()
    for _ in range(frames):
        values[:, joints] += step
        rig.stream(values, 1)
    rig.tick(TIMEOUT_TICKS + HZ)
    assert (rig.cerebellum.mode == Mode.HOLD).all()
    assert (rig.cerebellum.take_flags()[1] == Watchdog.COMMAND_AGE).all()
    rig.check()


def test_a_setpoint_replaces_a_goal() -> None:
    rig = Rig()
    rig.go(**SWEEP)
    rig.go(gripper=0.01)  # waits
    rig.tick(150)
    target = off(j0=-0.2)
    rig.stream(target, 1)
    assert rig.results() == [("1", ResultCode.REPLACED_BY_SETPOINT), ("2", ResultCode.REPLACED_BY_SETPOINT)]
    rig.stream(target, 50)
    assert {row[0] for row in rig.modes} == {Mode.TRACKING}
    assert np.allclose(rig.cerebellum.command[0], target, atol=1e-6)
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    rig.until(Mode.HOLD, TIMEOUT_TICKS + 1)  # now it counts that setpoints come
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.COMMAND_AGE]
    rig.check()


def test_a_goal_replaces_setpoints_and_finishes_without_them() -> None:
    rig = Rig()
    values = HOME.copy()
    for _ in range(10):
        values[1] += 0.01
        rig.stream(values, 1)
    assert rig.go(joint_target=posture(j0=1.0), max_velocity=1.0) is None
    rig.tick(2)
    rig.until(Mode.HOLD)
    assert rig.results() == [("1", ResultCode.SUCCEEDED)]
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    rig.check()


@pytest.mark.law
def test_a_goal_that_comes_while_the_arm_still_brakes_after_one_is_stopped_like_any_other() -> None:
    """A brain that falls silent twice: the second silence stops what it sent after the first."""
    rig = Rig()
    rig.go(**SWEEP)
    rig.tick(150)
    rig.cerebellum.interrupt(Watchdog.BRAIN, Mode.STOPPING)
    rig.tick(5)
    assert rig.mode == Mode.STOPPING
    assert rig.go(joint_target=posture(j0=-0.8), gripper=0.0) is None
    rig.tick(400)
    assert np.abs(rig.plant.velocity).max() > 0.5
    rig.cerebellum.interrupt(Watchdog.BRAIN, Mode.STOPPING)
    rig.tick(HZ)
    assert not np.diff(rig.plant.written[-100:], axis=0).any()
    assert rig.mode == Mode.HOLD
    assert rig.results() == [("1", ResultCode.CANCELLED), ("2", ResultCode.CANCELLED)]
    rig.check()


@pytest.mark.law
def test_an_emergency_stop_ends_a_goal_and_latches() -> None:
    rig = Rig()
    rig.go(**SWEEP)
    rig.go(gripper=0.05)
    rig.tick(200)
    rig.cerebellum.estop.press()
    rig.tick()
    assert rig.mode == Mode.ESTOP
    assert rig.results() == [("1", ResultCode.ESTOP), ("2", ResultCode.ESTOP)]
    refused = rig.go(**SWEEP)
    assert refused is not None
    assert refused.code == ResultCode.ESTOP
    assert "reset" in refused.message
    assert rig.send(HOME).reasons.tolist() == [Reason.ESTOP]
    assert rig.request(Request.RESET).reasons.tolist() == [Reason.NOT_AT_REST]
    rig.tick(400)
    assert np.array_equal(rig.rows[-1], rig.rows[-2])
    assert rig.request(Request.ACTIVATE).reasons.tolist() == [Reason.ESTOP]
    assert rig.request(Request.RESET).accepted.all()
    assert rig.mode == Mode.INACTIVE
    refused = rig.go(**SWEEP)
    assert refused is not None
    assert refused.code == ResultCode.NOT_ACTIVE
    assert rig.request(Request.ACTIVATE).accepted.all()
    rig.results()
    assert rig.go(**SWEEP) is None
    rig.tick()
    rig.until(Mode.HOLD)
    assert [code for _, code in rig.results()] == [ResultCode.SUCCEEDED]
    rig.check()


@pytest.mark.parametrize("by", ["goal", "setpoints"])
def test_a_deactivation_stops_and_switches_off(by: str) -> None:
    rig = Rig()
    if by == "goal":
        rig.go(**SWEEP)
        rig.tick(200)
    else:
        rig.stream(off(j0=0.5), 8)
    assert rig.request(Request.DEACTIVATE).accepted.all()
    assert rig.mode == Mode.STOPPING
    refused = rig.go(**SWEEP)
    assert refused is not None
    assert refused.code == ResultCode.NOT_ACTIVE
    assert rig.send(HOME).reasons.tolist() == [Reason.NOT_ACTIVE]
    rig.until(Mode.SAFE_OFF)
    codes = [code for _, code in rig.results()]
    assert codes == [ResultCode.NOT_ACTIVE] if by == "setpoints" else [ResultCode.CANCELLED, ResultCode.NOT_ACTIVE]
    rig.tick(50)
    assert np.array_equal(rig.rows[-1], rig.rows[-2])
    rig.check()


@pytest.mark.parametrize("what", ["no number", "fault"])
def test_a_reading_that_cannot_be_is_a_fault_and_ends_the_goal(what: str) -> None:
    rig = Rig(2)
    for sim in range(2):
        rig.go(sim, **SWEEP)
    rig.tick(200)
    if what == "fault":
        rig.plant.fault[0] = True
    else:
        rig.plant.lie[0] = {2: np.nan}
    rig.tick(300)
    assert rig.mode == Mode.FAULT
    assert rig.results(0) == [("1", ResultCode.FAULT)]
    refused = rig.go(**SWEEP)
    assert refused is not None
    assert refused.code == ResultCode.FAULT
    rig.plant.lie.clear()
    rig.plant.fault[:] = False
    rig.tick()
    assert rig.mode == Mode.FAULT  # it latches
    rig.tick(1500)
    assert rig.results(1) == [("2", ResultCode.SUCCEEDED)]  # the other arm noticed nothing
    rig.cerebellum.request(Request.RESET, np.array([0]))
    rig.cerebellum.request(Request.ACTIVATE, np.array([0]))
    assert rig.mode == Mode.HOLD
    rig.check()


def test_it_starts_from_the_posture_that_the_arm_is_in() -> None:
    rig = Rig(active=False)
    rig.plant.position[0] = off(j0=0.4, j3=-0.2, j6=-0.05)
    rig.request(Request.CONFIGURE)
    rig.request(Request.ACTIVATE)
    rig.rows.clear()
    rig.tick(20)
    assert np.array_equal(np.array(rig.rows)[:, 0], np.tile(off(j0=0.4, j3=-0.2, j6=-0.05), (20, 1)))
    assert rig.mode == Mode.HOLD


def test_a_restarted_arm_behaves_like_a_new_one() -> None:
    used, fresh = Rig(), Rig()
    used.go(**SWEEP)
    used.tick(130)
    used.stream(off(j0=9.0), 3)
    used.cerebellum.take_flags()
    used.cerebellum.restart(np.array([0]))
    used.tick(5)  # it is forgotten in motion, and stays where it is commanded to
    assert used.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    used.plant.position[:], used.plant.velocity[:] = HOME, 0.0
    used.cerebellum.restart(np.array([0]))
    used.request(Request.CONFIGURE)
    used.request(Request.ACTIVATE)
    assert used.results() == []
    assert used.cerebellum.take_flags()[0].tolist() == [Limit.NONE]
    for rig in (used, fresh):
        rig.rows.clear()
        rig.names = 0  # its names are free again
        rig.tick(3)
        assert rig.go(**SWEEP) is None
        rig.tick(600)
    assert np.array_equal(used.rows, fresh.rows)
    assert used.results() == fresh.results()


def test_limit_flags_are_set_and_cleared_by_reading() -> None:
    rig = Rig(3)
    values = np.tile(HOME, (3, 1))
    values[1] = off(j0=10.0)
    values[2] = off(j0=-3.0)
    for _ in range(6):
        rig.send(values)
        rig.tick(FRAME)
    limits = rig.cerebellum.take_flags()[0]
    assert limits[0] == Limit.NONE
    assert Limit(int(limits[1])) & ~Limit.EFFORT == Limit.POSITION | Limit.VELOCITY | Limit.ACCELERATION
    assert Limit(int(limits[2])) & ~Limit.EFFORT == Limit.VELOCITY | Limit.ACCELERATION
    rig.cerebellum.take_flags()
    assert rig.cerebellum.take_flags()[0].tolist() == [Limit.NONE] * 3


def test_an_arm_that_is_held_fast_is_asked_for_more_effort_than_it_has_and_its_goal_fails() -> None:
    rig = Rig(2)
    rig.plant.stuck[0] = True
    for sim in range(2):
        rig.go(sim, joint_target=posture(j0=0.5))
    rig.tick(1500)
    limits = rig.cerebellum.take_flags()[0]
    assert limits[0] & Limit.EFFORT
    assert not limits[1] & Limit.EFFORT
    assert rig.results(0) == [("1", ResultCode.PATH_TOLERANCE)]
    assert rig.results(1) == [("2", ResultCode.SUCCEEDED)]
    assert np.abs(rig.cerebellum.state(rig.now).joint_efforts[1]).max() < 1e-6  # at rest nothing is asked of a servo
    # The reference of a protective stop is where the joints are, at once; what the servos get does not jump.
    change = np.abs(np.diff(rig.plant.written, axis=0)).max(axis=(0, 1))
    assert (change <= rig.cerebellum.numbers["change"][0, :7]).all()
    assert not rig.modes[-1][0] == rig.modes[-1][1] == Mode.FAULT


actions = st.one_of(
    st.tuples(st.just("goal"), st.floats(-1, 1)),
    st.tuples(st.just("setpoint"), st.floats(-1, 1)),
    st.tuples(st.just("stream"), st.floats(-1, 1)),
    st.tuples(st.sampled_from(["cancel", "estop", "nan", "deactivate", "recover"]), st.just(0.0)),
)


def act(rig: Rig, kind: str, value: float) -> None:
    if kind == "goal":
        rig.go(joint_target=posture(j0=value, j4=-value / 2), gripper=0.04 * (1 + value), preempt=value > 0)
    elif kind == "setpoint":
        rig.send(off(j0=value, j1=value / 5, j6=-0.04 * (1 + value)))
    elif kind == "stream":
        for _ in range(3):
            rig.send(off(j0=value, j2=value / 5))
            rig.tick(FRAME)
    elif kind == "cancel":
        rig.cerebellum.controller.cancel(0, str(rig.names))
    elif kind == "estop":
        rig.cerebellum.estop.press()
    elif kind == "nan":
        rig.plant.lie[0] = {2: np.nan}
    elif kind == "deactivate":
        rig.request(Request.DEACTIVATE)
    else:
        rig.plant.lie.clear()
        rig.request(Request.RESET)
        rig.request(Request.ACTIVATE)


@settings(max_examples=12)
@example([(("goal", 1.0), 137), (("stream", 0.0), 0), (("stream", 0.0), 0), (("goal", 0.0), 1), (("setpoint", 0.0), 1)])
@given(st.lists(st.tuples(actions, st.integers(0, 200)), max_size=10))
def test_random_histories_have_no_jump_and_one_result_per_goal(script: list) -> None:
    rig = Rig()
    results = []
    for (kind, value), ticks in script:
        act(rig, kind, value)
        rig.tick(ticks)
        results += rig.results()
    act(rig, "estop", 0.0)
    rig.tick(500)
    results += rig.results()
    rig.check()
    assert np.array_equal(rig.rows[-1], rig.rows[-2])
    assert sorted(name for name, _ in results) == sorted(str(k) for k in range(1, rig.names + 1))


@pytest.mark.parametrize("silence", [0.1, 0.35, 0.45])
def test_while_nothing_is_read_a_moving_arm_is_not_blocked(silence: float) -> None:
    """The readings stand for a while, with their stamps; the arm moves on, and then reads where it is."""
    rig = Rig()
    rig.cerebellum.readings.accept_until(NANOSECONDS, NANOSECONDS)
    stamp, read = np.ones(1, np.int64), rig.plant.read
    kept: list[np.ndarray] = []

    def stale(out: PlantReading) -> None:
        read(out)
        out.stamp_ns = stamp
        if rig.now % NANOSECONDS < silence * NANOSECONDS and kept:
            out.position[:], out.velocity[:] = kept[-2:]
        else:
            kept[:] = out.position.copy(), out.velocity.copy()
            stamp[0] = rig.now + 1

    rig.plant.read = stale  # type: ignore[method-assign]
    rig.go(joint_target=posture(j0=2.0))
    rig.tick(4 * HZ)
    assert max(mode for [mode] in rig.modes) < Mode.ESTOP
    rig.check()


@pytest.mark.parametrize(("moved", "cause"), [(False, "has not moved since"), (True, "something is in its way")])
def test_an_arm_that_never_moved_is_named_otherwise_than_one_that_is_blocked(moved: bool, cause: str) -> None:
    rig = Rig()
    if moved:
        rig.go(joint_target=posture(j0=0.3))
        rig.tick(3 * HZ)
    rig.plant.stuck[:] = True
    rig.go(joint_target=posture(j0=2.0))
    rig.tick(3 * HZ)
    assert rig.cerebellum.mode[0] == Mode.FAULT
    assert cause in rig.controller.cause


@pytest.mark.law
def test_a_stop_is_not_over_before_the_arm_is_at_rest_however_often_it_stops() -> None:
    rig, side, resets = Rig(), 1.5, []
    for _ in range(3):
        side = -side
        rig.stream(off(j0=side), 6)
        rig.until(Mode.STOPPING)
        assert np.abs(rig.controller.velocity).max() > 0.1
        rig.until(Mode.HOLD)
        assert not rig.controller.velocity.any()
        rig.cerebellum.interrupt(Watchdog.MISSES, Mode.FAULT)
        rig.tick()
        resets.append(0)
        while not rig.request(Request.RESET).accepted.all():
            rig.tick()
            resets[-1] += 1
        assert rig.request(Request.ACTIVATE).accepted.all()
        rig.tick(5)
    assert resets == [resets[0]] * 3
    assert resets[0] > 10


def test_an_arm_is_not_reset_before_it_is_known_where_it_is() -> None:
    rig = Rig(active=False)
    rig.plant.lie[0] = {2: np.nan}
    rig.tick(50)
    assert rig.mode == Mode.FAULT
    for _ in range(3):
        assert rig.request(Request.RESET).reasons.tolist() == [Reason.FAULT]
        rig.tick()
    rig.plant.lie.clear()
    for request in (Request.RESET, Request.ACTIVATE):
        assert rig.request(request).accepted.all()
    rig.tick(5)
    np.testing.assert_allclose(rig.plant.written, np.tile(HOME, (5, 1, 1)), atol=1e-9)
