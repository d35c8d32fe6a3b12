"""Rigid-body dynamics of an arm: what torques do to it, and what a tool sees of its inertia."""

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, GripperSpec
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.versions import check_version

check_version("pin")

Array = NDArray[np.float64]

TOOL_SITE = "tool"
SWING = 1.5  # [1] so many times the torque that accelerating a joint needs does its servo give for a moment
_POSTURES, _LEAST_SHARE = 1000, 0.1


@dataclass(frozen=True)
class DynamicsTerms:
    """The dynamics of n arms in one state: mass @ acceleration + coriolis @ velocity + gravity = torque.

    Lengths, angles and torques are those of the arm's six joints, the gripper's fingers are held. Frames are given in
    the base frame.

    Attributes:
        mass: joint-space mass matrix with the rotors' inertia [kg m^2], shape (n, 6, 6).
        coriolis: the Coriolis matrix for which d(mass)/dt = coriolis + coriolis^T [N m s/rad], shape (n, 6, 6).
        gravity: torques that carry the arm's weight [N m], shape (n, 6).
        jacobian: geometric Jacobian at the tool centre point, linear velocity first, shape (n, 6, 6).
        tool: the tool frame, shape (n, 4, 4).
    """

    mass: Array
    coriolis: Array
    gravity: Array
    jacobian: Array
    tool: Array

    def mobility(self, damping: float = 0.0) -> Array:
        """Return the inverse of the inertia that a wrench on the tool moves, shape (n, 6, 6).

        It is singular where the Jacobian is, and its inverse then infinite: what cannot move weighs for ever.

        Args:
            damping: what is added to its diagonal [1/kg, 1/(kg m^2)], so that it can be inverted near a singularity.
        """
        transposed = np.swapaxes(self.jacobian, 1, 2)
        mobility = self.jacobian @ np.linalg.solve(self.mass, transposed)
        mobility += damping * np.eye(6)
        return 0.5 * (mobility + np.swapaxes(mobility, 1, 2))


class ArmDynamics:
    """The rigid-body model of an arm, from the same MJCF that is simulated, with its declared load.

    The gripper's inertia is that of the opening at home. Its centre of mass does not depend on it, because the fingers
    move as one.

    Raises:
        ConfigError: the MJCF has other joints than the arm's chain and gripper, no tool, or the opening is impossible.
    """

    def __init__(self, body: Body) -> None:
        arm = body.need(Arm)
        self.model = _of_inertias(arm) if arm.inertias else _of_mjcf(body)
        self.dof = self.model.nv
        self._tool = self.model.getFrameId(TOOL_SITE)
        if arm.load:
            last = self.model.frames[self._tool].parentJoint
            lever = self.model.frames[self._tool].placement.translation
            self.model.inertias[last] += pinocchio.Inertia(arm.load, lever, np.zeros((3, 3)))
        self._data = self.model.createData()

    def fill(self, row: Any) -> None:
        """Write the rigid bodies into the record of limits that a tick finds torques with."""
        model = self.model
        for k in range(self.dof):
            joint, placed, inertia = model.joints[k + 1], model.jointPlacements[k + 1], model.inertias[k + 1]
            axes = {"JointModelRX": (1, 0, 0), "JointModelRY": (0, 1, 0), "JointModelRZ": (0, 0, 1)}
            if joint.shortname() not in axes:
                raise ConfigError(
                    f"Joint {model.names[k + 1]!r} of the MJCF turns about none of its body's axes x, y, z."
                )
            row["axis"][k] = axes[joint.shortname()]
            row["turn"][k], row["offset"][k] = placed.rotation, placed.translation
            row["mass"][k], row["centre"][k], row["inertia"][k] = inertia.mass, inertia.lever, inertia.inertia
        row["rotor"][: self.dof] = model.armature
        tool = model.frames[self._tool].placement
        row["tool_turn"], row["tool_offset"] = tool.rotation, tool.translation

    def terms(self, position: Array, velocity: Array) -> DynamicsTerms:
        """Return the dynamics in a state of n arms.

        Args:
            position: joint positions [rad], shape (n, 6).
            velocity: joint speeds [rad/s], shape (n, 6).
        """
        n, dof, model, data = len(position), self.dof, self.model, self._data
        mass, coriolis, jacobian = (np.empty((n, rows, dof)) for rows in (dof, dof, 6))
        gravity, tool = np.empty((n, dof)), np.empty((n, 4, 4))
        for sim in range(n):
            q, v = position[sim], velocity[sim]
            pinocchio.computeJointJacobians(model, data, q)
            pinocchio.updateFramePlacements(model, data)
            jacobian[sim] = pinocchio.getFrameJacobian(model, data, self._tool, pinocchio.LOCAL_WORLD_ALIGNED)
            tool[sim] = data.oMf[self._tool].homogeneous
            upper = np.triu(pinocchio.crba(model, data, q))
            mass[sim] = upper + np.triu(upper, 1).T
            coriolis[sim] = pinocchio.computeCoriolisMatrix(model, data, q, v)
            gravity[sim] = pinocchio.computeGeneralizedGravity(model, data, q)
        return DynamicsTerms(mass, coriolis, gravity, jacobian, tool)

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the torques that a motion needs, weight included [N m], shape (n, 6): inverse dynamics.

        Args:
            position: joint positions [rad], shape (n, 6).
            velocity: joint speeds [rad/s], shape (n, 6).
            acceleration: [rad/s^2], shape (n, 6).
        """
        torque = np.empty(position.shape)
        for sim in range(len(position)):
            torque[sim] = pinocchio.rnea(self.model, self._data, position[sim], velocity[sim], acceleration[sim])
        return torque


def acceleration_share(body: Body) -> float:
    """Return the share of an arm's accelerations that its motors can give in any posture, with its declared load.

    All joints at once, in the worst directions: for motions that are not planned. An arm without a load is taken to be
    able to do what its limits say.
    """
    arm = body.need(Arm)
    if not arm.load or not body.mjcf:
        return 1.0
    dof = len(arm.chain.joints)
    lower, upper = np.asarray(arm.limits.lower[:dof]), np.asarray(arm.limits.upper[:dof])
    acceleration, effort = np.asarray(arm.limits.acceleration[:dof]), np.asarray(arm.limits.effort[:dof])
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, dof))
    terms = ArmDynamics(body).terms(postures, np.zeros_like(postures))
    room = effort - np.abs(terms.gravity)
    return float(np.clip((room / (SWING * np.abs(terms.mass) @ acceleration)).min(), _LEAST_SHARE, 1.0))


def product(matrices: Array, vectors: Array) -> Array:
    """Return each matrix, shape (n, i, j), times its vector, shape (n, j); the same bits whatever n is."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _of_mjcf(body: Body) -> pinocchio.Model:
    arm, gripper = body.need(Arm), body.need(GripperSpec)
    opening = arm.home[-1]
    if not 0.0 <= opening <= gripper.max_opening:
        raise ConfigError(f"The gripper's opening is {opening} m; it must be between 0 and {gripper.max_opening} m.")
    whole = _parse(body)
    joints, wanted = tuple(whole.names)[1:], (*arm.chain.joints, *gripper.joints)
    if joints != wanted:
        raise ConfigError(f"The MJCF of {body.name!r} has the joints {joints}; it needs {wanted}.")
    posture = pinocchio.neutral(whole)
    if not whole.existFrame(TOOL_SITE):
        if not re.search(rf"<site\b[^>]*\bname=[\"']{TOOL_SITE}[\"']", body.mjcf):
            raise ConfigError(f"The MJCF of {body.name!r} has no site {TOOL_SITE!r}, the tool centre point.")
        _add_tool(whole, arm, posture)
    posture[-2:] = opening / 2
    locked = [whole.getJointId(name) for name in gripper.joints]
    model = pinocchio.buildReducedModel(whole, locked, posture)
    model.armature = whole.armature[: model.nv]  # version 3 of Pinocchio drops it; the fingers are the last
    return model


def _of_inertias(arm: Arm) -> pinocchio.Model:
    model, last = pinocchio.Model(), 0
    places = (arm.chain.base, *arm.chain.links)
    for name, place, inertia in zip(arm.chain.joints, places, arm.inertias, strict=False):
        last = model.addJoint(last, pinocchio.JointModelRZ(), pinocchio.SE3(place.matrix()), name)
        about = pinocchio.Inertia(inertia.mass, np.array(inertia.centre), np.array(inertia.about))
        model.appendBodyToJoint(last, about, pinocchio.SE3.Identity())
    model.armature = np.array([inertia.rotor for inertia in arm.inertias])
    tool = pinocchio.SE3(places[-1].matrix() @ arm.chain.tool.matrix())
    model.addFrame(pinocchio.Frame(TOOL_SITE, last, 0, tool, pinocchio.FrameType.OP_FRAME))
    return model


def _add_tool(whole: pinocchio.Model, arm: Arm, posture: Array) -> None:
    """Add the tool frame, of the arm's chain: Pinocchio reads the sites of an MJCF since version 4 only."""
    data = whole.createData()
    pinocchio.forwardKinematics(whole, data, posture)
    last = whole.getJointId(arm.chain.joints[-1])
    tool = pinocchio.SE3(ForwardKinematics(arm.chain).tool(posture[: arm.chain.dof]))
    whole.addFrame(pinocchio.Frame(TOOL_SITE, last, 0, data.oMi[last].actInv(tool), pinocchio.FrameType.OP_FRAME))


def _parse(body: Body) -> pinocchio.Model:
    """Return the model of the whole MJCF; the parser reads files only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{body.name}.xml"
        path.write_text(body.mjcf, encoding="utf-8")
        try:
            return pinocchio.buildModelFromMJCF(str(path))
        except (ValueError, RuntimeError) as error:
            raise ConfigError(f"The MJCF of {body.name!r} is not valid: {error}") from error
