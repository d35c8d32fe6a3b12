"""The estimate of how hard an arm presses, at made-up efforts."""

import numpy as np
import pytest

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.arm.force_limit import ForceLimit
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

HZ = 500
ARM = ur5()
DYNAMICS = ArmDynamics(ARM)
HOME = np.array(ARM.arm.home[:6])


def reading_of(forces: np.ndarray, postures: np.ndarray = HOME) -> PlantReading:
    """Return arms at rest whose tools press with forces [N], base frame, shape (n, 3)."""
    n = len(forces)
    reading = PlantReading(n, 7)
    reading.position[:, :6] = postures
    terms = DYNAMICS.terms(reading.position[:, :6], reading.velocity[:, :6])
    jacobian = terms.jacobian[:, :3]
    reading.effort[:, :6] = terms.gravity + np.einsum("nij,ni->nj", jacobian, forces)
    reading.has_effort = True
    return reading


def test_forces_are_estimated_and_compared_with_the_largest() -> None:
    forces = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -100.0), (0.0, 0.0, -200.0), (0.0, 160.0, 160.0)])
    limit = ForceLimit(ARM, 4, HZ, 150.0)
    reading = reading_of(forces)
    hits = [limit.update(reading) for _ in range(100)]
    np.testing.assert_allclose(
        limit.force, np.linalg.norm(forces, axis=1), rtol=0.12
    )  # singular directions are left out
    assert limit.exceeded.tolist() == [False, False, True, True]
    assert hits.index(True) * 1000 / HZ < 80  # [ms]
    assert "150 N is the most" in limit.explain()
    limit.restart(np.array([2]))
    assert limit.force[2] == 0.0
    assert not limit.exceeded[2]


@pytest.mark.parametrize("seed", range(3))
def test_forces_in_random_postures_and_directions_are_found_as_the_page_says(seed: int) -> None:
    rng, kinematics = np.random.default_rng(seed), ArmKinematics(ARM.arm.chain, ARM.limits)
    postures = np.array(ARM.arm.home)[:6] + rng.uniform(-1.5, 1.5, (1000, 6))
    free = np.min(kinematics.collision.distances(postures), axis=0) > 0.02
    postures = np.repeat(postures[free][:160], 20, axis=0)
    forces = rng.normal(size=(len(postures), 3))
    forces *= 150.0 / np.linalg.norm(forces, axis=1)[:, None]
    limit, reading = ForceLimit(ARM, len(postures), HZ, 150.0), reading_of(forces, postures)
    for _ in range(100):
        limit.update(reading)
    share = limit.force / 150.0
    assert np.median(share) > 0.97
    assert np.quantile(share, 0.05) > 0.85
    assert np.quantile(share, 0.01) > 0.68
    assert share.max() < 1.02


def test_what_is_estimated_does_not_depend_on_how_many_arms_there_are() -> None:
    forces = np.array([(3.0, 0.0, -90.0), (0.0, 20.0, -200.0), (0.0, 160.0, 1.0)])
    together = ForceLimit(ARM, 3, HZ, 150.0)
    reading = reading_of(forces)
    for _ in range(50):
        together.update(reading)
    for sim in range(3):
        alone, one = ForceLimit(ARM, 1, HZ, 150.0), reading_of(forces[sim : sim + 1])
        for name in ("position", "velocity", "effort"):
            getattr(one, name)[:] = getattr(reading, name)[sim : sim + 1]
        for _ in range(50):
            alone.update(one)
        assert alone.force[0] == together.force[sim]


def test_a_plant_that_measures_no_efforts_has_no_limit() -> None:
    limit = ForceLimit(ARM, 1, HZ, 150.0)
    reading = reading_of(np.array([(0.0, 0.0, -500.0)]))
    reading.has_effort = False
    assert not any(limit.update(reading) for _ in range(100))


@pytest.mark.parametrize("largest", [0.0, -1.0, float("nan")])
def test_a_limit_has_to_be_positive(largest: float) -> None:
    with pytest.raises(ConfigError, match=r"max_force is .*positive"):
        ForceLimit(ARM, 1, HZ, largest)
