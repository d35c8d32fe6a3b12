"""What impedance control is made of: compliance, and the equilibrium that moves."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.arm.compliance import Compliance, find_damping
from bhd_lerobot.control.arm.equilibrium import (
    ACCELERATION,
    SPEED,
    TURN_ACCELERATION,
    TURN_SPEED,
    head_for_setpoint,
    move_equilibrium,
)
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.record import new_springs, new_states
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

Array = NDArray[np.float64]
ARM = ur5(actuation="torque")
HZ = 500
DYNAMICS = ArmDynamics(ARM)
HOME = np.array(ARM.arm.home)


def find(mobility: Array, stiffness: Array, ratio: float) -> Array:
    springs = new_springs(1)
    springs["mobility"], springs["stiffness"], springs["ratio"] = mobility, stiffness, ratio
    find_damping(as_objects(springs)[0])
    return springs["damping"][0]


@pytest.mark.parametrize("ratio", [0.3, 0.7, 1.0])
def test_every_mode_has_the_damping_ratio(ratio: float) -> None:
    rng = np.random.default_rng(1)
    q = HOME[:6] + rng.uniform(-0.5, 0.5, (5, 6))
    for mobility in DYNAMICS.terms(q, 0 * q).mobility(1e-3):
        root = rng.uniform(-1, 1, (6, 6))
        stiffness = root @ root.T * 300 + 200 * np.eye(6)
        damping = find(mobility, stiffness, ratio)
        np.testing.assert_allclose(damping, damping.T, rtol=1e-9, atol=1e-6)
        dynamics = np.block([[np.zeros((6, 6)), np.eye(6)], [-mobility @ stiffness, -mobility @ damping]])
        poles = np.linalg.eigvals(dynamics)
        np.testing.assert_allclose(-poles.real / np.abs(poles), ratio, atol=1e-3)


def test_axes_without_stiffness_are_damped() -> None:
    assert np.linalg.eigvalsh(find(np.eye(6) / 10, np.zeros((6, 6)), 1.0)).min() > 1


BAD = {
    "symmetric": {"stiffness": np.eye(6) * 100 + np.eye(6, k=1)},
    "may be negative": {"stiffness": (-1.0, 1, 1, 1, 1, 1)},
    "6 finite numbers": {"stiffness": (1.0, 2.0)},
    "finite": {"stiffness": (float("nan"), 1, 1, 1, 1, 1)},
    "6000 N/m": {"stiffness": (6000.0, 1, 1, 1, 1, 1)},
    "400 N m/rad": {"stiffness": (1.0, 1, 1, 1, 400, 1)},
    "damping_ratio": {"damping_ratio": 0.4},
    "The damping": {"damping": (-1.0, 1, 1, 1, 1, 1)},
    "max_force": {"max_force": 1000.0},
    "max_moment": {"max_moment": float("inf")},
}


@each_case("message", BAD)
def test_an_impossible_compliance_is_refused(message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Compliance(**BAD[message])  # type: ignore[arg-type]


def test_a_compliance_cannot_be_changed_behind_its_checks() -> None:
    values = np.full(6, 100.0)
    compliance = Compliance(values)
    values[:] = -1.0
    assert np.linalg.eigvalsh(compliance.stiffness).min() > 0
    with pytest.raises(ValueError, match="read-only"):
        np.asarray(compliance.stiffness)[0, 0] = -1.0


class Follower:
    """An equilibrium at the origin, and what it did in each tick."""

    def __init__(self) -> None:
        controller = ImpedanceController(ARM, 1, HZ, 20)
        self.states, self.springs = new_states(1), new_springs(1)
        [self._state], [self._spring] = as_objects(self.states), as_objects(self.springs)
        [self._limits] = as_objects(controller.arm_limits)

    def head_for(self, values: Array) -> None:
        self.states["requested"][0] = values
        assert head_for_setpoint(self._state, self._spring, self._limits)

    def run(self, ticks: int) -> dict[str, Array]:
        """Return what it did, the start included, shape (ticks + 1, ...)."""
        log: dict[str, list[Array]] = {"place": [], "turn": [], "opening": [], "speed": []}
        for tick in range(ticks + 1):
            for name, values in log.items():
                values.append(self.springs[name][0].copy())
            if tick < ticks:
                move_equilibrium(self._state, self._spring, self._limits)
        return {name: np.array(values) for name, values in log.items()}


@pytest.mark.parametrize("seed", range(4))
def test_it_arrives_within_its_limits_along_a_straight_line(seed: int) -> None:
    rng, one = np.random.default_rng(seed), Follower()
    place, opening, turn = rng.uniform(-0.4, 0.4, 3), rng.uniform(0, MAX_OPENING), rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    one.head_for(np.array([*place, *turn, opening]))
    log = one.run(2200)
    speed, change = log["speed"], np.diff(log["speed"], axis=0) * HZ
    assert np.linalg.norm(speed[:, :3], axis=1).max() <= SPEED + 1e-9
    assert np.linalg.norm(speed[:, 3:], axis=1).max() <= TURN_SPEED + 1e-9
    assert np.linalg.norm(change[:, :3], axis=1).max() <= ACCELERATION + 1e-9
    assert np.linalg.norm(change[:, 3:], axis=1).max() <= TURN_ACCELERATION + 1e-9
    np.testing.assert_allclose(log["place"][-1], place, atol=1e-6)
    np.testing.assert_allclose(log["opening"][-1], opening, atol=1e-6)
    assert abs(log["turn"][-1] @ turn) == pytest.approx(1.0, abs=1e-10)
    along = place / np.linalg.norm(place)
    assert np.abs(log["place"] - np.outer(log["place"] @ along, along)).max() < 1e-6
    axis = turn[1:] / np.linalg.norm(turn[1:])
    assert np.abs(np.cross(log["turn"][:, 1:], axis)).max() < 1e-6


def test_a_steady_stream_is_followed_without_a_lag() -> None:
    one, target = Follower(), np.array([0.0, 0, 0, 1, 0, 0, 0, 0])
    for _ in range(50):
        target[0] += 0.1 / 25
        one.head_for(target)
        log = one.run(20)
    assert log["speed"][-1][0] == pytest.approx(0.1, abs=1e-3)
    assert log["place"][-1][0] == pytest.approx(target[0], abs=3e-4)  # a tick's way
