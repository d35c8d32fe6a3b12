"""What a body looks like and weighs, by its parts, as other programs describe robots."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.sim.engine import mujoco

_SEEN = 1  # the group of geometries that are drawn
_KINDS: dict[int, Literal["box", "cylinder", "sphere", "capsule"]] = {
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
}


@dataclass(frozen=True)
class Solid:
    """A shape that is drawn.

    Attributes:
        kind: its kind.
        size: half the lengths of a box, radius and half the length of a cylinder or a capsule, radius of a sphere [m].
        pose: in the body's frame, shape (4, 4).
        rgba: its colour, 0 to 1.
    """

    kind: Literal["box", "cylinder", "sphere", "capsule"]
    size: tuple[float, ...]
    pose: NDArray[np.float64]
    rgba: tuple[float, ...]


@dataclass(frozen=True)
class Part:
    """A rigid part.

    Attributes:
        name: of MuJoCo's body.
        parent: of the part that it is on, empty for none.
        mass: [kg].
        centre: of mass, in the body's frame [m], shape (3,).
        inertia: about the centre of mass, along the axes of the body's frame [kg m^2], shape (3, 3).
        solids: what is drawn of it.
    """

    name: str
    parent: str
    mass: float
    centre: NDArray[np.float64]
    inertia: NDArray[np.float64]
    solids: tuple[Solid, ...]


def parts_of(body: Body) -> list[Part]:
    """Return the parts of a body with all joints at zero, parents first; poses are in the frame of its MJCF's world."""
    model = mujoco.MjModel.from_xml_string(body.mjcf)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    parts = []
    for index in range(1, model.nbody):
        turn = data.ximat[index].reshape(3, 3)
        solids = tuple(
            Solid(
                _KINDS[int(model.geom_type[geom])],
                tuple(model.geom_size[geom].tolist()),
                _pose(data.geom_xmat[geom], data.geom_xpos[geom]),
                tuple(_colour(model, geom).tolist()),
            )
            for geom in range(model.ngeom)
            if model.geom_bodyid[geom] == index and model.geom_group[geom] == _SEEN
        )
        parent = int(model.body_parentid[index])
        parts.append(
            Part(
                model.body(index).name,
                model.body(parent).name if parent else "",
                float(model.body_mass[index]),
                data.xipos[index].copy(),
                turn @ np.diag(model.body_inertia[index]) @ turn.T,
                solids,
            )
        )
    return parts


def _pose(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def _colour(model: mujoco.MjModel, geom: int) -> NDArray[np.float32]:
    material = int(model.geom_matid[geom])
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
