"""The numbers of an episode: jerk of known motions, paths of known length, flags counted by kind, digests."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.evaluation.metrics import JerkMeasure, measure
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Event, Outcome

FPS = 10
BASE = ("x.vel", "theta.vel")


def episode(
    applied: np.ndarray, event: Event = Event.SUCCESS, plan: dict | None = None, **columns: np.ndarray
) -> Episode:
    frames = len(applied)
    timing = TimingStatistics(10_000_000)
    timing.add_punctual(frames * 10)
    values = {
        keys.ACTION: applied.astype(np.float32),
        keys.APPLIED_ACTION: applied.astype(np.float32),
        keys.PHYSICS_STATE: np.zeros((frames, 3)),
        keys.REWARD: np.full(frames, 0.25, np.float32),
        keys.LIMITS: np.zeros(frames, np.int64),
        keys.WATCHDOG: np.zeros(frames, np.int64),
        keys.MODE: np.full(frames, int(Mode.TRACKING)),
        **columns,
    }
    outcome = Outcome(event == Event.SUCCESS, event, 0.5, {"path_m": 1.0})
    none = np.zeros(0)
    return Episode(
        spec=EpisodeSpec(3, 2**62 + 1), scene=None, instruction="", initial_state=np.arange(4.0), columns=values,
        outcome=outcome, timing=timing.summary(age=none, late=none.astype(bool)), writer=None, plan=plan or {},
    )  # fmt: skip


def measured(given: Episode, track: np.ndarray | None = None, names: tuple[str, ...] = BASE):
    track = np.zeros((given.frames, 7)) if track is None else track
    return measure("it", given, track, JerkMeasure.of(names), FPS)


def test_jerk_of_a_speed_that_is_a_parabola_is_constant():
    t = np.arange(30) / FPS
    applied = np.stack([0.5 * 0.04 * t**2, np.sin(40 * t)], axis=1)  # how it turns does not matter
    metrics = measured(episode(applied))
    assert metrics.jerk_mean == pytest.approx(0.04, rel=1e-3)
    assert metrics.jerk_max == pytest.approx(0.04, rel=1e-2)


@pytest.mark.law
def test_jerk_of_joints_is_the_length_of_the_third_derivative_without_the_gripper():
    t = np.arange(40) / FPS
    cubic = t**3 / 6
    applied = np.stack([0.3 * cubic, 0.4 * cubic, *[0 * t] * 4, 5 * cubic], axis=1)
    metrics = measured(episode(applied), names=ur5().limits.names)
    assert metrics.jerk_mean == pytest.approx(0.5, rel=1e-2)


@pytest.mark.parametrize("kept", [[0, 1, 2, 5, 6, 7, 8, 9], list(range(0, 30, 2)), list(range(30))], ids=len)
def test_a_robot_that_leaves_frames_out_on_the_wall_clock_has_the_jerk_and_the_duration_of_its_motion(kept) -> None:
    t = np.array(kept) / FPS
    given = episode(np.stack([0.5 * 0.04 * t**2, np.sin(40 * t)], axis=1))
    jitter = 0.01 * np.cos(np.arange(len(t)))
    live = replace(
        given, timing=replace(given.timing, clock="realtime"), columns={**given.columns, keys.TIME: t + jitter}
    )
    metrics = measured(live)
    assert metrics.jerk_mean == pytest.approx(0.04, rel=1e-2)
    assert metrics.jerk_max == pytest.approx(0.04, rel=3e-2)
    assert metrics.length_s == pytest.approx((kept[-1] + 1) / FPS, abs=0.03)


def test_a_robot_at_rest_and_one_at_constant_speed_have_no_jerk_and_a_short_episode_has_none_defined():
    assert measured(episode(np.full((20, 2), 0.2))).jerk_max == 0.0
    assert math.isnan(measured(episode(np.zeros((2, 2)))).jerk_mean)


def test_path_is_the_length_of_the_line_in_space():
    track = np.zeros((5, 7))
    track[:, 0], track[:, 2] = 3 * np.arange(5), 4 * np.arange(5)
    assert measured(episode(np.zeros((5, 2))), track).path_m == pytest.approx(20.0)


@pytest.mark.law
def test_flags_are_counted_by_kind_in_frames():
    limits = np.array([0, Limit.VELOCITY, Limit.VELOCITY | Limit.EFFORT, Limit.ACCELERATION])
    watchdog = np.array([Watchdog.COMMAND_AGE, 0, Watchdog.COMMAND_AGE | Watchdog.BLOCKED, 0])
    metrics = measured(
        episode(np.zeros((4, 2)), **{keys.LIMITS: limits.astype(np.int64), keys.WATCHDOG: watchdog.astype(np.int64)})
    )
    assert metrics.limits == {
        "non_finite": 0,
        "velocity": 2,
        "acceleration": 1,
        "effort": 1,
        "position": 0,
        "posture": 0,
        "clearance": 0,
    }
    assert {name: count for name, count in metrics.watchdogs.items() if count} == {"command_age": 2, "blocked": 1}


def test_latched_stops_are_counted():
    for mode, stops, faults in ((Mode.ESTOP, 1, 0), (Mode.FAULT, 0, 1), (Mode.HOLD, 0, 0)):
        modes = np.array([Mode.TRACKING, mode], np.int64)
        metrics = measured(episode(np.zeros((2, 2)), **{keys.MODE: modes}))
        assert (metrics.estops, metrics.faults) == (stops, faults)


def test_digests_tell_different_episodes_apart():
    one, same = episode(np.zeros((4, 2))), episode(np.zeros((4, 2)))
    other = episode(np.zeros((4, 2)))
    other.columns[keys.PHYSICS_STATE][2, 1] = np.nextafter(0.0, 1.0)
    assert measured(one).digest == measured(same).digest != measured(other).digest
    assert measured(one).initial_state == measured(other).initial_state
