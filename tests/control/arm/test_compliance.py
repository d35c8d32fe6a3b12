"""What impedance control is made of: compliance, the equilibrium that moves, and the contact estimate."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.ur5 import MAX_OPENING, ur5
from bhd_lerobot.control.arm.compliance import Compliance, critical_damping
from bhd_lerobot.control.arm.equilibrium import ACCELERATION, SPEED, TURN_ACCELERATION, TURN_SPEED, Equilibrium
from bhd_lerobot.control.arm.rotations import rotation_matrices, rotation_vectors
from bhd_lerobot.control.arm.wrench import ContactObserver
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

Array = NDArray[np.float64]
ARM = ur5(actuation="torque")
HZ = 500
DYNAMICS = ArmDynamics(ARM)
HOME = np.array(ARM.arm.home)
ALL = np.ones(1, np.bool_)


@pytest.mark.parametrize("ratio", [0.3, 0.7, 1.0])
def test_every_mode_has_the_damping_ratio(ratio: float) -> None:
    rng = np.random.default_rng(1)
    q = HOME[:6] + rng.uniform(-0.5, 0.5, (5, 6))
    mobility = DYNAMICS.terms(q, 0 * q).mobility(1e-3)
    root = rng.uniform(-1, 1, (5, 6, 6))
    stiffness = root @ root.swapaxes(1, 2) * 300 + 200 * np.eye(6)
    damping = critical_damping(mobility, stiffness, np.full(5, ratio))
    np.testing.assert_allclose(damping, damping.swapaxes(1, 2), rtol=1e-9, atol=1e-6)
    for k in range(5):
        dynamics = np.block([[np.zeros((6, 6)), np.eye(6)], [-mobility[k] @ stiffness[k], -mobility[k] @ damping[k]]])
        poles = np.linalg.eigvals(dynamics)
        np.testing.assert_allclose(-poles.real / np.abs(poles), ratio, atol=1e-3)


def test_axes_without_stiffness_are_damped() -> None:
    mobility = np.eye(6)[None] / 10
    damping = critical_damping(mobility, np.zeros((1, 6, 6)), np.ones(1))
    assert np.linalg.eigvalsh(damping).min() > 1


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


def equilibrium(n: int = 1) -> Equilibrium:
    return Equilibrium(n, HZ, 20, (0.15, 2.0))


def run(one: Equilibrium, ticks: int) -> dict[str, Array]:
    """Run some ticks and return what the equilibria did in each, the start included, shape (ticks + 1, n, ...)."""
    log: dict[str, list[Array]] = {"position": [], "rotation": [], "opening": [], "speed": []}
    for tick in range(ticks + 1):
        for name, values in log.items():
            values.append(getattr(one, name).copy())
        if tick < ticks:
            one.run()
    return {name: np.array(values) for name, values in log.items()}


def test_it_arrives_within_its_limits_along_a_straight_line() -> None:
    n, rng = 20, np.random.default_rng(5)
    one = equilibrium(n)
    position, opening = rng.uniform(-0.4, 0.4, (n, 3)), rng.uniform(0, MAX_OPENING, (n, 1))
    rotation = rotation_matrices(rng.normal(size=(n, 4)))
    one.set_setpoint(position, rotation, opening, np.ones(n, np.bool_))
    log = run(one, 2200)
    speed, change = log["speed"], np.diff(log["speed"], axis=0) * HZ
    assert np.linalg.norm(speed[:, :, :3], axis=2).max() <= SPEED + 1e-9
    assert np.linalg.norm(speed[:, :, 3:], axis=2).max() <= TURN_SPEED + 1e-9
    assert np.linalg.norm(change[:, :, :3], axis=2).max() <= ACCELERATION + 1e-9
    assert np.linalg.norm(change[:, :, 3:], axis=2).max() <= TURN_ACCELERATION + 1e-9
    np.testing.assert_allclose(log["position"][-1], position, atol=1e-6)
    np.testing.assert_allclose(log["opening"][-1], opening, atol=1e-6)
    assert np.abs(rotation_vectors(log["rotation"][-1] @ rotation.swapaxes(1, 2))).max() < 1e-5
    along = position / np.linalg.norm(position, axis=1, keepdims=True)
    across = log["position"] - (log["position"] * along).sum(axis=2, keepdims=True) * along
    assert np.abs(across).max() < 1e-6


def test_a_steady_stream_is_followed_without_a_lag() -> None:
    one = equilibrium()
    target = np.zeros((1, 3))
    for _ in range(50):
        target[0, 0] += 0.1 / 25
        one.set_setpoint(target, one.rotation.copy(), one.opening.copy(), ALL)
        log = run(one, 20)
    assert log["speed"][-1][0, 0] == pytest.approx(0.1, abs=1e-3)
    assert one.position[0, 0] == pytest.approx(target[0, 0], abs=3e-4)  # a tick's way


@pytest.mark.parametrize("gain", [0.0, -1.0, 501.0, float("nan")])
def test_an_impossible_gain_is_refused(gain: float) -> None:
    with pytest.raises(ConfigError, match="gain"):
        ContactObserver(1, 6, HZ, gain)
