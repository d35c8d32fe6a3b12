"""The estimate of how hard an arm presses, at made-up efforts."""

import numpy as np

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.force_limit import explain_force, feel, forget_force
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.kernels import as_objects

HZ = 500
ARM = ur5()
DYNAMICS = ArmDynamics(ARM)
HOME = np.array(ARM.arm.home[:6])


class Felt:
    """Arms at rest whose tools press with forces [N], base frame, shape (n, 3)."""

    def __init__(self, forces: np.ndarray, postures: np.ndarray = HOME) -> None:
        n = len(forces)
        self.controller = controller = ArmController(ARM, n, HZ, 20, max_force=150.0)
        position, velocity, effort = (controller.states[name][:, :6] for name in ("position", "velocity", "effort"))
        position[:] = postures
        terms = DYNAMICS.terms(position, velocity)
        effort[:] = terms.gravity + np.einsum("nij,ni->nj", terms.jacobian[:, :3], forces)
        self.arms, self.limits, self.states = controller.arms, controller.arm_limits[0], controller.states
        controller.states["has_effort"] = True
        [geometry, *_], [limits] = as_objects(controller.geometries), as_objects(controller.arm_limits)
        pairs = zip(as_objects(controller.states), as_objects(self.arms), strict=True)
        self._records = [(state, arm, limits, geometry) for state, arm in pairs]

    def update(self, ticks: int = 1) -> int:
        """Let ticks go by; return the first in which any force was too large, or -1."""
        for tick in range(ticks):
            presses = [feel(*records) for records in self._records]
            if any(presses):
                return tick
        return -1


def test_forces_are_estimated_and_compared_with_the_largest() -> None:
    forces = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -100.0), (0.0, 0.0, -200.0), (0.0, 160.0, 160.0)])
    felt = Felt(forces)
    assert 0 <= felt.update(100) * 1000 / HZ < 80  # [ms]
    for _ in range(100):
        felt.update()
    # Singular directions are left out.
    np.testing.assert_allclose(felt.arms["force"], np.linalg.norm(forces, axis=1), rtol=0.12)
    assert felt.arms["presses"].tolist() == [False, False, True, True]
    assert "150 N is the most" in explain_force(ARM, felt.arms[2], felt.limits)
    forget_force(felt.states[2], felt.arms[2])
    assert felt.arms["force"][2] == 0.0
    assert not felt.arms["presses"][2]


def test_forces_in_random_postures_and_directions_are_found_as_the_page_says() -> None:
    rng, kinematics = np.random.default_rng(0), ArmKinematics(ARM.arm.chain, ARM.limits)
    postures = np.array(ARM.arm.home)[:6] + rng.uniform(-1.5, 1.5, (1000, 6))
    free = np.min(kinematics.collision.distances(postures), axis=0) > 0.02
    postures = np.repeat(postures[free][:60], 8, axis=0)
    forces = rng.normal(size=(len(postures), 3))
    forces *= 150.0 / np.linalg.norm(forces, axis=1)[:, None]
    felt = Felt(forces, postures)
    for _ in range(100):
        felt.update()
    share = felt.arms["force"] / 150.0
    assert np.median(share) > 0.97
    assert np.quantile(share, 0.05) > 0.85
    assert np.quantile(share, 0.01) > 0.68
    assert share.max() < 1.02


def test_a_plant_that_measures_no_efforts_has_no_limit() -> None:
    felt = Felt(np.array([(0.0, 0.0, -500.0)]))
    felt.states["has_effort"] = False
    assert felt.update(100) == -1
