"""The rigid-body model beside two oracles: the closed-form kinematics, and the engine that simulates the same MJCF."""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.geometry.dynamics import ArmDynamics, _parse
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.geometry.rigid_bodies import find_dynamics, find_mobility
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

ARM = ur5(actuation="torque")
DYNAMICS = ArmDynamics(ARM)
RNG = np.random.default_rng(3)
POSTURES = RNG.uniform(-3, 3, (40, 6))
SPEEDS = RNG.uniform(-2, 2, (40, 6))
TERMS = DYNAMICS.terms(POSTURES, SPEEDS)
ENGINE = mujoco.MjModel.from_xml_string(ARM.mjcf)


def engine_at(q: NDArray[np.float64], v: NDArray[np.float64], opening: float) -> mujoco.MjData:
    data = mujoco.MjData(ENGINE)
    data.qpos[:6], data.qpos[6:], data.qvel[:6] = q, opening / 2, v
    mujoco.mj_forward(ENGINE, data)
    return data


def at_home_open(opening: float) -> Body:
    return replace(ARM, arm=replace(ARM.arm, home=(*ARM.arm.home[:-1], opening)))


@pytest.mark.law
@pytest.mark.parametrize("opening", [0.0, 0.03, MAX_OPENING])
def test_it_agrees_with_the_engine(opening: float) -> None:
    dynamics = ArmDynamics(at_home_open(opening))
    terms, still = dynamics.terms(POSTURES, SPEEDS), dynamics.terms(POSTURES, 0 * SPEEDS)
    for k in range(len(POSTURES)):
        data = engine_at(POSTURES[k], SPEEDS[k], opening)
        mass = np.zeros((8, 8))
        mujoco.mj_fullM(ENGINE, data, mass)
        np.testing.assert_allclose(terms.mass[k], mass[:6, :6], atol=1e-12)
        np.testing.assert_allclose(terms.coriolis[k] @ SPEEDS[k] + terms.gravity[k], data.qfrc_bias[:6], atol=1e-10)
        np.testing.assert_allclose(
            terms.gravity[k], engine_at(POSTURES[k], 0 * SPEEDS[k], opening).qfrc_bias[:6], atol=1e-10
        )
    np.testing.assert_array_equal(still.coriolis @ np.ones(6), np.zeros((40, 6)))
    kinematics = ArmKinematics(ARM.arm.chain, ARM.limits)
    np.testing.assert_allclose(terms.tool, kinematics.tool(POSTURES), atol=1e-12)
    np.testing.assert_allclose(terms.jacobian, kinematics.jacobian(POSTURES), atol=1e-12)


@pytest.mark.law
def test_what_a_tick_computes_is_what_pinocchio_does() -> None:
    controller = ImpedanceController(ARM, 1, 500, 20)
    [spring], [limits] = as_objects(controller.springs), as_objects(controller.arm_limits)
    for k, (q, v) in enumerate(zip(POSTURES, SPEEDS, strict=True)):
        find_dynamics(spring, limits, np.pad(q, (0, 2)), np.pad(v, (0, 2)))
        mass, coriolis, gravity = TERMS.mass[k], TERMS.coriolis[k], TERMS.gravity[k]
        for mine, expected in (
            (np.triu(spring.mass[:6, :6]), np.triu(mass)),
            (spring.momentum[:6], mass @ v),
            (spring.own[:6], coriolis @ v + gravity),
            (spring.gradient[:6], coriolis.T @ v),
            (spring.gravity[:6], gravity),
            (spring.jacobian[:, :6], TERMS.jacobian[k]),
            (spring.tool, TERMS.tool[k, :3, 3]),
            (np.abs(spring.tool_turn @ pose_vectors(TERMS.tool[k])[3:]), 1.0),
        ):
            np.testing.assert_allclose(mine, expected, atol=1e-11)
        find_mobility(spring, limits, 1e-3)
        np.testing.assert_allclose(spring.mobility, TERMS.mobility(1e-3)[k], atol=1e-11)


def test_the_coriolis_matrix_is_half_of_how_the_mass_matrix_changes() -> None:
    """What the momentum observer rests on."""
    step = 1e-6
    later = DYNAMICS.terms(POSTURES + step * SPEEDS, SPEEDS).mass
    earlier = DYNAMICS.terms(POSTURES - step * SPEEDS, SPEEDS).mass
    np.testing.assert_allclose(
        TERMS.coriolis + TERMS.coriolis.swapaxes(1, 2), (later - earlier) / (2 * step), atol=1e-6
    )


def test_mobility_matches_the_response_to_a_tool_wrench() -> None:
    wrench = RNG.uniform(-10, 10, (40, 6))
    torque = np.einsum("kji,kj->ki", TERMS.jacobian, wrench)
    acceleration = np.linalg.solve(TERMS.mass, torque[..., None])
    np.testing.assert_allclose(
        TERMS.mobility() @ wrench[..., None], TERMS.jacobian @ acceleration, rtol=1e-9, atol=1e-9
    )


def test_the_damped_mobility_has_an_inverse_in_a_singular_posture() -> None:
    stretched = np.array([[0.0, -1.0, 0.0, -1.0, 0.0, 0.0]])
    terms = DYNAMICS.terms(stretched, np.zeros((1, 6)))
    assert abs(np.linalg.eigvalsh(terms.mobility()).min()) < 1e-9
    assert np.linalg.eigvalsh(terms.mobility(1e-3)).min() == pytest.approx(1e-3, rel=1e-3)


@each_case(
    ("body", "message"),
    [
        *((at_home_open(opening), "opening") for opening in (-0.01, 0.1, float("nan"))),
        (replace(ARM, mjcf=ARM.mjcf.replace('name="elbow" class="hinge"', 'name="knee" class="hinge"')), "it needs"),
        (replace(ARM, mjcf="<mujoco"), "not valid"),
        (replace(ARM, mjcf=ARM.mjcf.replace('<site name="tool"', '<site name="tip"')), "has no site 'tool'"),
    ],
)
def test_a_body_that_cannot_be_is_refused(body: Body, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ArmDynamics(body)


def test_it_is_the_same_with_version_3_of_pinocchio(monkeypatch: pytest.MonkeyPatch) -> None:
    """That one reads no sites, and drops the rotors' inertia where joints are held."""
    read, reduce = pinocchio.buildModelFromMJCF, pinocchio.buildReducedModel

    def without_sites(path: str) -> pinocchio.Model:
        text = Path(path).read_text(encoding="utf-8")
        Path(path).write_text(re.sub(r"<site[^>]*/>", "", text), encoding="utf-8")
        return read(path)

    def without_rotors(*arguments: object) -> pinocchio.Model:
        model = reduce(*arguments)
        model.armature = 0 * model.armature
        return model

    for load in (0.0, 1.5):
        expected = ArmDynamics(replace(ARM, arm=replace(ARM.arm, load=load))).terms(POSTURES, SPEEDS)
        with monkeypatch.context() as patch:
            patch.setattr(pinocchio, "buildModelFromMJCF", without_sites)
            patch.setattr(pinocchio, "buildReducedModel", without_rotors)
            assert not _parse(ARM).existFrame("tool")
            terms = ArmDynamics(replace(ARM, arm=replace(ARM.arm, load=load))).terms(POSTURES, SPEEDS)
        for name in ("mass", "coriolis", "gravity", "jacobian", "tool"):
            np.testing.assert_allclose(getattr(terms, name), getattr(expected, name), atol=1e-12)
