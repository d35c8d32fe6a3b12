"""The geometry of an arm, read from its MuJoCo model."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import reduce
from itertools import chain as chained
from itertools import count, product
from operator import add
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import HELD, OBSTACLE, ArmChain, Capsule, Placement
from bhd_lerobot.control.geometry.capsules import Balls, enclosing, halves, with_pairs
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.record import JOINTS, PAIRS, SHAPES
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.sim.engine import mujoco

Array = NDArray[np.float64]

_FREE, _HINGE, _SLIDE = (
    int(kind) for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
)
_KINDS = {_FREE: "a free joint", int(mujoco.mjtJoint.mjJNT_BALL): "a ball joint", _SLIDE: "a slide joint"}
_EQ_CONNECT, _EQ_WELD, _EQ_JOINT = (
    int(kind) for kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_JOINT)
)
_MOST_SHAPES, _MOST_PAIRS = SHAPES - 16, PAIRS - 256  # room for obstacles and for what is held
_SINGULAR, _POSTURES = 0.05, 500  # of the median manipulability of so many postures: below it one counts as singular
_ROUND, _SPHERE, _WIDER = 24, 200, 1.02  # points on a rim, on an ellipsoid, and by how much that is made larger
_SAME = 1e-9  # [m and 1] poses that differ by less are one


def chain_from_mjcf(
    model: mujoco.MjModel | str,
    tool: str | tuple[str, Placement],
    *,
    root: str | None = None,
    home: Mapping[str, float] | None = None,
    min_distance: float = 0.005,
) -> ArmChain:
    """Return the geometry of an arm: the hinges from its root to its tool, with capsules around the geoms.

    Of each link the geoms that collide are enclosed, or all if none does; meshes, boxes, cylinders and ellipsoids by
    their convex hulls. What is moved by a joint behind the tool's body, such as a finger, is enclosed at both ends of
    its range. The tool frame is that of the site: z points out of the gripper, y from the left to the right finger.

    Args:
        model: the compiled model, or an MJCF document.
        tool: the name of the site that is the tool frame; or the name of a body, and the tool frame in it.
        root: the name of the body whose frame is the base frame, or ``"world"``; the lowest body that the tool hangs
            on if left out, or the world if that one turns itself. Joints of the root's own are no part of the arm.
        home: positions of joints by name [rad or m] at which capsules that touch are not checked; those of the keyframe
            ``"home"``, or of the first one, if left out; without one the joints' zeros, or the middles of ranges that
            do not hold them.
        min_distance: smallest distance that checks will permit [m].

    Raises:
        ConfigError: the model is not valid, or what it describes is no such arm; the message has the name and a remedy.
    """
    model = _compiled(model)
    body, placement = _find_tool(model, tool)
    base, path = _way(model, body, root)
    joints = [joint for one in path for joint in _joints_of(model, one)]
    frames = _frames_of_bodies(model, base, path)
    _check(model, joints, frames, root)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    into_base = np.linalg.inv(_pose(data.xpos[base], data.xmat[base]))
    axes = [into_base @ _joint_frame(model, data, joint) for joint in joints]
    # In the frames of joints that stand where the model has their zero.
    zeros = [axis @ _turned_back(_zero(model, joint)) for axis, joint in zip(axes, joints, strict=True)]
    flange = into_base @ _pose(data.xpos[body], data.xmat[body])
    steps = [np.linalg.inv(axis) @ after for axis, after in zip(axes, (*zeros[1:], flange), strict=True)]
    chain = ArmChain(
        joints=tuple(model.joint(joint).name for joint in joints),
        links=tuple(map(Placement.of, steps)),
        base=Placement.of(zeros[0]),
        tool=placement,
        capsules=(),
        disjoint=(),
        min_distance=min_distance,
        min_manipulability=0.0,
    )
    forward, (lower, upper) = ForwardKinematics(chain), _ranges(model, joints)
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, chain.dof))
    least = _SINGULAR * float(np.median(forward.manipulability(postures)))
    at_home = _home(model, home)
    places = forward.frames(np.array([_zero(model, joint) for joint in joints]))
    shapes = _shapes(model, joints, frames, at_home, np.linalg.inv(places) @ into_base)
    posture = at_home[model.jnt_qposadr[joints]]
    for most, cut in ((SHAPES, True), (SHAPES, False), (2, False), (1, False)):
        capsules = _capsules(shapes, most, cut=cut)
        chain = replace(chain, capsules=capsules, min_manipulability=least)
        if len(capsules) <= _MOST_SHAPES:
            chain = with_pairs(chain, posture, lower, upper)
            if len(chain.disjoint) <= _MOST_PAIRS:
                break
    return chain


# --- the joints ------------------------------------------------------------------------------------------------------


def _compiled(model: mujoco.MjModel | str) -> mujoco.MjModel:
    if not isinstance(model, str):
        return model
    try:
        return mujoco.MjModel.from_xml_string(model)
    except ValueError as error:
        raise ConfigError(f"The MJCF of the arm does not compile: {error}") from error


def _names(model: mujoco.MjModel, kind: Literal["body", "site", "joint"], number: int) -> list[str]:
    return [getattr(model, kind)(one).name for one in range(number)]


def _find_tool(model: mujoco.MjModel, tool: str | tuple[str, Placement]) -> tuple[int, Placement]:
    """Return the body that carries the tool, and the tool frame in it."""
    if not isinstance(tool, str):
        bodies = _names(model, "body", model.nbody)
        if tool[0] not in bodies:
            raise ConfigError(unknown_name("body of the tool", tool[0], bodies))
        return bodies.index(tool[0]), tool[1]
    sites = _names(model, "site", model.nsite)
    if tool not in sites:
        remedy = "" if model.nsite else " The model has no sites: add one, or name a body and the tool frame in it."
        raise ConfigError(unknown_name("site of the tool", tool, sites) + remedy)
    site = sites.index(tool)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.site_quat[site])
    return int(model.site_bodyid[site]), Placement.of(_pose(model.site_pos[site], rotation))


def _joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body])))


def _way(model: mujoco.MjModel, body: int, root: str | None) -> tuple[int, list[int]]:
    """Return the body of the base frame, and the bodies from there to the tool's."""
    way = [body]
    while way[-1]:
        way.append(int(model.body_parentid[way[-1]]))
    way.reverse()  # from the world on
    if root is None:
        lowest = way[1:2]
        turns = lowest and any(model.jnt_type[joint] != _FREE for joint in _joints_of(model, lowest[0]))
        at = 0 if turns or not lowest else 1
    else:
        names = _names(model, "body", model.nbody)
        if root not in names:
            raise ConfigError(unknown_name("root body", root, names))
        if names.index(root) not in way:
            hangs = " on ".join(repr(names[one]) for one in reversed(way))
            raise ConfigError(
                f"The tool is not on the chain that begins at {root!r}: it is on {hangs}. Name one of these."
            )
        at = way.index(names.index(root))
    return way[at], way[at + 1 :]


def _frames_of_bodies(model: mujoco.MjModel, base: int, path: Sequence[int]) -> list[int | None]:
    """Return which frame of the chain each body is behind; None for those that are no part of the arm."""
    frames: list[int | None] = [None] * model.nbody
    frames[base] = 0
    for body in range(1, model.nbody):
        before = frames[model.body_parentid[body]]
        floats = any(model.jnt_type[joint] == _FREE for joint in _joints_of(model, body))
        if before is not None and body != base and not (floats and body not in path):
            frames[body] = before + len(_joints_of(model, body)) if body in path else before
    return frames


def _check(model: mujoco.MjModel, joints: Sequence[int], frames: Sequence[int | None], root: str | None) -> None:
    """Refuse what is no serial arm of hinges."""
    if not joints:
        raise ConfigError(
            "There is no joint between the root and the tool. Name a tool that the joints move, or a root before them."
        )
    dof, names = len(joints), _names(model, "joint", model.njnt)
    for joint in joints:
        kind, link, name = int(model.jnt_type[joint]), model.body(model.jnt_bodyid[joint]).name, names[joint]
        if kind != _HINGE:
            raise ConfigError(
                f"The joint {name!r} of the body {link!r} on the way to the tool is {_KINDS[kind]}; an arm's joints "
                "are hinges. Name a root behind it, or fix it in the model."
            )
        if not name:
            raise ConfigError(f"A joint of the body {link!r} on the way to the tool has no name; give it one.")
    if dof > JOINTS - 1:
        raise ConfigError(
            f"The arm has {dof} joints, {', '.join(names[joint] for joint in joints)}; {JOINTS - 1} is the most. Name "
            "a root farther out."
        )
    for joint in range(model.njnt):
        body = model.jnt_bodyid[joint]
        frame = frames[body]
        of_root = frame == 0 and (not body or frames[model.body_parentid[body]] is None)
        elsewhere = frame is None and root is not None
        if joint in joints or model.jnt_type[joint] == _FREE or frame == dof or of_root or elsewhere:
            continue
        what = "in another tree" if frame is None else "on a branch beside the way to the tool"
        raise ConfigError(
            f"The joint {names[joint]!r} is {what}. Say where the arm begins with root=, a body from which all joints "
            "lead to the tool."
        )
    for number in range(model.neq):
        _check_equality(model, number, joints, frames)


def _check_equality(model: mujoco.MjModel, number: int, joints: Sequence[int], frames: Sequence[int | None]) -> None:
    """Refuse what closes a loop with the arm's links, or couples its joints. A gripper may do so."""
    kind, ends = int(model.eq_type[number]), (int(model.eq_obj1id[number]), int(model.eq_obj2id[number]))
    name = model.equality(number).name or f"number {number}"
    if kind == _EQ_JOINT:
        coupled = [model.joint(joint).name for joint in ends if joint in joints]
        if coupled:
            raise ConfigError(
                f"The equality {name!r} couples the arm's joint {coupled[0]!r}; it has to move by itself."
            )
    elif kind in (_EQ_CONNECT, _EQ_WELD):
        if int(model.eq_objtype[number]) == int(mujoco.mjtObj.mjOBJ_SITE):
            ends = (int(model.site_bodyid[ends[0]]), int(model.site_bodyid[ends[1]]))
        one, other = (frames[end] for end in ends)
        if one != other and (one or other):
            bodies = " and ".join(repr(model.body(end).name) for end in ends)
            raise ConfigError(
                f"The equality {name!r} closes a loop with {bodies}; an arm is an open chain. Remove it, or name a "
                "root behind it."
            )


def _joint_frame(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Array:
    """Return a frame at the anchor of a joint whose z axis is the joint's, turned as little as can be from its body."""
    body = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
    axis = body.T @ data.xaxis[joint]
    turn, _ = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])
    return _pose(data.xanchor[joint], body @ turn.as_matrix())


def _zero(model: mujoco.MjModel, joint: int) -> float:
    """Return the position of a joint in which the model describes the bodies: its reference."""
    return float(model.qpos0[model.jnt_qposadr[joint]])


def _turned_back(angle: float) -> Array:
    return _pose(np.zeros(3), Rotation.from_euler("z", -angle).as_matrix())


def _pose(position: Array, rotation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def _ranges(model: mujoco.MjModel, joints: Sequence[int]) -> tuple[Array, Array]:
    limited = model.jnt_limited[joints].astype(bool)
    lower, upper = model.jnt_range[joints].T
    return np.where(limited, lower, -np.pi), np.where(limited, upper, np.pi)


def _home(model: mujoco.MjModel, home: Mapping[str, float] | None) -> Array:
    keys = [model.key(number).name for number in range(model.nkey)]
    qpos = np.array(model.key_qpos[keys.index("home") if "home" in keys else 0] if keys else model.qpos0)
    for joint in range(0 if keys else model.njnt):
        low, high = model.jnt_range[joint]
        at = model.jnt_qposadr[joint]
        if model.jnt_limited[joint] and model.jnt_type[joint] in (_HINGE, _SLIDE) and not low <= qpos[at] <= high:
            qpos[at] = (low + high) / 2
    for name, value in (home or {}).items():
        joints = _names(model, "joint", model.njnt)
        if name not in joints:
            raise ConfigError(unknown_name("joint of the home posture", name, joints))
        qpos[model.jnt_qposadr[joints.index(name)]] = value
    return qpos


# --- the shapes ------------------------------------------------------------------------------------------------------


def _shapes(
    model: mujoco.MjModel, joints: Sequence[int], frames: Sequence[int | None], at_home: Array, into: Array
) -> list[tuple[str, int, Balls]]:
    """Return the name, the frame and the shape of each geom of the arm.

    Args:
        at_home: positions of all joints.
        into: the transforms from the world into the frames in which the chain's joints are where the model has them.
    """
    own = [geom for geom in range(model.ngeom) if frames[model.geom_bodyid[geom]] is not None]
    own = [geom for geom in own if model.geom_bodyid[geom]]  # what stands in the world is no arm
    collide = [geom for geom in own if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    solid = {frames[model.geom_bodyid[geom]] for geom in collide}
    others = [j for j in range(model.njnt) if j not in joints and model.jnt_type[j] in (_HINGE, _SLIDE)]
    data, shapes = mujoco.MjData(model), []
    seen: dict[int, list[Array]] = {}
    for end in (0, 1):
        data.qpos[:] = at_home
        data.qpos[model.jnt_qposadr[joints]] = model.qpos0[model.jnt_qposadr[joints]]
        for joint in others:
            if model.jnt_limited[joint] and frames[model.jnt_bodyid[joint]]:
                data.qpos[model.jnt_qposadr[joint]] = model.jnt_range[joint, end]
        mujoco.mj_kinematics(model, data)
        for geom in own:
            frame = frames[model.geom_bodyid[geom]]
            if frame is None or (frame in solid and geom not in collide):
                continue
            pose = into[frame] @ _pose(data.geom_xpos[geom], data.geom_xmat[geom])
            if any(np.abs(pose - before).max() < _SAME for before in seen.get(geom, [])):
                continue
            shape = _balls(model, geom)
            if shape is not None:
                name = model.geom(geom).name or model.body(model.geom_bodyid[geom]).name
                own_name = f"link_{name}" if name.startswith((HELD, OBSTACLE)) else name  # which are no links
                shapes.append((own_name, frame, shape.moved(pose)))
                seen.setdefault(geom, []).append(pose)
    return shapes


def _balls(model: mujoco.MjModel, geom: int) -> Balls | None:
    """Return the shape of a geom in its own frame; None for one that bounds nothing, such as a plane."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return Balls(np.zeros((1, 3)), size[:1].copy())
    if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
        return Balls(np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), np.repeat(size[0], 2))
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
        rim = np.stack((np.cos(angle), np.sin(angle)), axis=1) * size[0] / np.cos(np.pi / _ROUND)
        points = np.concatenate([np.column_stack((rim, np.full(_ROUND, height))) for height in (-size[1], size[1])])
    elif kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        points = np.array(list(product((-1.0, 1.0), repeat=3))) * size
    elif kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        number = np.arange(_SPHERE) + 0.5
        height, angle = 1 - 2 * number / _SPHERE, np.pi * (1 + np.sqrt(5)) * number
        across = np.sqrt(1 - height * height)
        points = np.stack((across * np.cos(angle), across * np.sin(angle), height), axis=1) * size * _WIDER
    elif kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
        with suppress(QhullError):  # of what is flat
            points = points[ConvexHull(points).vertices]
    else:
        return None
    return Balls(points, np.zeros(len(points)))


def _capsules(shapes: Sequence[tuple[str, int, Balls]], most: int, *, cut: bool) -> tuple[Capsule, ...]:
    """Return capsules around shapes, so many for each frame at the most."""
    capsules: dict[str, Capsule] = {}
    for frame in sorted({frame for _, frame, _ in shapes}):
        own = [(name, shape) for name, number, shape in shapes if number == frame]
        if cut:
            own = [(name, half) for name, shape in own for half in halves(shape)]
        for name, shape in own if len(own) <= most else _merged(own, most):
            start, end, radius = enclosing(shape)
            unique = next(one for one in chained((name,), (f"{name}_{k}" for k in count(2))) if one not in capsules)
            capsules[unique] = Capsule(unique, frame, tuple(start.tolist()), tuple(end.tolist()), radius)
    return tuple(capsules.values())


def _merged(shapes: Sequence[tuple[str, Balls]], most: int) -> list[tuple[str, Balls]]:
    """Return unions of shapes: of all, or of those towards either end of the link."""
    middles = np.array([shape.centres.mean(axis=0) for _, shape in shapes])
    middles -= middles.mean(axis=0)
    along = middles @ np.linalg.svd(middles)[2][0]
    halves = [along <= 0.0, along > 0.0] if most > 1 else [along <= np.inf]
    parts = [[shape for shape, one in zip(shapes, half, strict=True) if one] for half in halves]
    return [(part[0][0], reduce(add, (shape for _, shape in part))) for part in parts if part]
