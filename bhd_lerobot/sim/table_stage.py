"""What stands around an arm: table, room, lights, cameras, and the objects that each simulation makes its own.

World frame and base frame are one; the table's top is the plane z = 0. An arm on a base has an arena instead, with the
same objects, servos and sensors of touches: see scene.py.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, GripperSpec, Shape
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, CameraView, scene_camera
from bhd_lerobot.sim.backdrop import add_backdrop
from bhd_lerobot.sim.engine import mujoco

TABLE_BIT, ARM_BIT, OBJECT_BIT, GROUND_BIT = 1, 2, 4, 8  # contact bits; those of the arm are in its MJCF
HANDLE_PARTS = 3
# Absent objects float, without weight, far above the table and far from each other, where they are dropped at once from
# the search for contacts. Below it they would touch it: a plane is solid all the way down.
PARKED = tuple((3.0 * number, 0.0, 100.0) for number in range(MAX_OBJECTS))
FLOOR = -0.75  # [m]
_OVERVIEW = CameraView((1.75, -1.30, 0.95), (0.30, 0.0, 0.20), 29.0)
_OVERSEEN = 1.4  # [m] reach of the arms that it is made for; it sees as much more as others reach farther
TABLE_TOP = "table_top"  # what is seen of it
_TABLE = (-0.35, 1.05, 0.70)  # edges behind and before the base, half the width [m]


def add_table_stage(spec: mujoco.MjSpec, root: str, arm: Arm, fixtures: Sequence[Shape] = ()) -> None:
    """Add everything around an arm, and the arm's actuators, to the specification of its body.

    Fixtures stand on the table and do not give way; sensor ``force_fixture_<k>`` is the force that the k-th puts on the
    arm, in the base frame [N].
    """
    _add_servos(spec, arm, carries=[body.name for body in spec.bodies if body.name not in ("world", root)])
    add_options(spec)
    _add_room(spec)
    _add_table(spec)
    _add_lights(spec)
    overview = replace(_OVERVIEW, fovy=_OVERVIEW.fovy * max(1.0, arm.chain.reach / _OVERSEEN))
    for name, view in (("scene", scene_camera(arm.workspace)), ("overview", overview)):
        axes = _towards(view.position, view.target)
        spec.worldbody.add_camera(name=name, pos=view.position, xyaxes=axes, fovy=view.fovy)
    _add_handled(spec, arm.gripper)
    _add_touch_sensors(spec, arm, root, root, "table")
    for number, shape in enumerate(fixtures):
        _add_fixture(spec, root, number, shape)


def add_mobile_arm(spec: mujoco.MjSpec, root: str, arm: Arm) -> None:
    """Add the actuators of an arm on a base, what it handles, and its sensors of touches, to the stage of the base.

    The base carries the arm's weight, which a compensation would take off it: the servos are let down by it.
    """
    _add_servos(spec, arm, carries=())
    _add_handled(spec, arm.gripper)
    # On the body that the sensors know as the scene, for the arm alone: wheels roll on the other floor.
    spec.body("scene").add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=GROUND_BIT, conaffinity=0, group=3
    )
    _add_touch_sensors(spec, arm, spec.joint(arm.chain.joints[0]).parent.name, root, "scene")


def _add_handled(spec: mujoco.MjSpec, gripper: GripperSpec | None) -> None:
    """Add the objects, the marker of a wanted pose, and the keyframe that `set_home` fills in."""
    for number in range(MAX_OBJECTS):
        _add_object(spec, number, gripper)
    _add_target(spec)
    spec.add_key(name="home")


def _add_servos(spec: mujoco.MjSpec, arm: Arm, carries: Sequence[str]) -> None:
    """Add one actuator for each joint and the gripper's, with the arm's gains and limits.

    Position servos carry the weight of the bodies named.
    """
    positions = arm.actuation == "position"
    rows = zip(arm.actuators, arm.servo_stiffness, arm.servo_damping, arm.limits.effort, strict=True)
    for number, (name, stiffness, damping, effort) in enumerate(rows):
        grip = arm.gripper if number == len(arm.chain.joints) else None
        tendon = grip.tendon if grip else ""
        closed, way = (grip.pull[0], grip.pull[1] / grip.max_opening) if grip else (0.0, 1.0)
        actuator = spec.add_actuator(
            name=name,
            target=tendon or (grip.joints[0] if grip else arm.chain.joints[number]),
            trntype=mujoco.mjtTrn.mjTRN_TENDON if tendon else mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-effort / abs(way), effort / abs(way)],
        )
        if grip or positions:
            actuator.set_to_position(kp=stiffness / way**2, kv=damping / way**2)
            if (closed, way) != (0.0, 1.0):  # its command is an opening, and what it pulls has another length
                actuator.gainprm[0], actuator.biasprm[0] = stiffness / way, stiffness / way**2 * closed
        else:
            actuator.set_to_motor()
    for joint, damping, effort in zip(arm.chain.joints, arm.brake_damping, arm.limits.effort, strict=False):
        brake = spec.add_actuator(
            name=f"{joint}_brake",
            target=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=[-effort, effort],
            ctrlrange=[0.0, 1e6],
        )
        brake.set_to_damper(kv=damping)
    # The robot's own controller carries its own weight, with torque that counts against the limits.
    for body in spec.bodies:
        if positions and body.name in carries:
            body.gravcomp = 1.0
            for joint in body.joints:
                joint.actgravcomp = True


def add_options(spec: mujoco.MjSpec) -> None:
    """Choose solver settings: what is gripped and the wheels must not creep, and a step should cost little.

    With the defaults a wheel creeps through its contact by several per cent, which would be an odometry error that no
    real tyre has. The mid phase walks a bounding-volume tree that is compiled once; obstacles move between episodes.
    """
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE


def _add_room(spec: mujoco.MjSpec) -> None:
    add_backdrop(
        spec,
        sky=((0.86, 0.88, 0.90), (0.62, 0.66, 0.70)),
        floor=((0.46, 0.48, 0.50), (0.42, 0.44, 0.46)),
    )
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[20, 20, 2],  # in squares of 2 m: see sim/scene.py
        pos=[0, 0, FLOOR],
        material="stage_floor",
        contype=0,
        conaffinity=0,
    )


def _add_table(spec: mujoco.MjSpec) -> None:
    """Add a table that is only rendered, and a plane to touch, without edges: contacts with it are cheap and exact."""
    spec.add_material(name="stage_table", rgba=[0.70, 0.56, 0.40, 1.0], specular=0.15, shininess=0.3)
    spec.add_material(name="stage_leg", rgba=[0.25, 0.26, 0.28, 1.0], specular=0.3)
    table = spec.worldbody.add_body(name="table")
    # The larger friction of the two that touch counts: with so little here it is the object's.
    table.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=TABLE_BIT,
        conaffinity=0,
        condim=3,
        friction=[0.01, 0.001, 0.0001],
        group=3,
    )
    back, front, half = _TABLE
    middle, length = (back + front) / 2, (front - back) / 2
    _visual(table, "box", (middle, 0, -0.02), (length, half, 0.02), name=TABLE_TOP, material="stage_table")
    _visual(table, "box", (0, 0, 0.0005), (0.11, 0.11, 0.0015), material="stage_leg")  # the mounting plate
    for x in (back + 0.06, front - 0.06):
        for y in (-half + 0.06, half - 0.06):
            _visual(table, "box", (x, y, (FLOOR - 0.04) / 2), (0.03, 0.03, -(FLOOR + 0.04) / 2), material="stage_leg")


def _add_lights(spec: mujoco.MjSpec) -> None:
    """Add a main light and a fill; nearly all brightness is theirs, so that a factor on them is one on the image's."""
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        name="main", type=directional, pos=[0.5, -1, 3], dir=[-0.35, 0.45, -1.0], diffuse=[0.55] * 3, ambient=[0.18] * 3
    )
    spec.worldbody.add_light(
        name="fill", type=directional, pos=[1, 1, 2], dir=[-0.6, -0.7, -0.6], diffuse=[0.28] * 3, ambient=[0.10] * 3
    )
    spec.visual.headlight.ambient = [0.06] * 3
    spec.visual.headlight.diffuse = [0.10] * 3
    spec.visual.headlight.specular = [0.0] * 3
    # Near and far planes are multiples of the extent; left to MuJoCo it would span to the parked objects.
    spec.stat.extent = 2.0
    spec.stat.center = [0.3, 0.0, 0.2]
    spec.visual.map.znear = 0.004
    # Shadows and multi-sampling off: with a software renderer a frame costs twenty times as much with them.
    spec.visual.quality.shadowsize = 0
    # Bands along a cylinder: the default's 16 take a software renderer twice the time, and only balls show them.
    spec.visual.quality.numstacks = 6
    spec.visual.quality.offsamples = 0


def _add_object(spec: mujoco.MjSpec, number: int, gripper: GripperSpec | None) -> None:
    """Add a free body with one geometry to touch and some only rendered; each simulation gives them their size."""
    body = spec.worldbody.add_body(name=f"object_{number}", pos=PARKED[number], gravcomp=1.0)
    body.add_freejoint(name=f"object_{number}")
    # As long as the inertia is a sphere's, the compiler turns no axes; simulations write theirs for the body's.
    body.mass, body.inertia, body.ipos, body.explicitinertial = 0.2, [2e-4] * 3, [0.0] * 3, True
    body.add_geom(
        name=f"object_{number}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.05, 0.05, 0.05],
        contype=OBJECT_BIT,
        conaffinity=TABLE_BIT | ARM_BIT | OBJECT_BIT,
        condim=3,
        mass=0.0,
        group=5,
    )
    for part in ("top", *(f"handle_{index}" for index in range(HANDLE_PARTS))):
        _visual(body, "box", (0, 0, 0), (0.001,) * 3, name=f"object_{number}_{part}", group=5)
    # Written out as pairs, the pads' friction is a property of the two that touch; and only what is gripped needs
    # friction against turning.
    for pad in gripper.pads if gripper else ():
        spec.add_pair(
            geomname1=pad,
            geomname2=f"object_{number}",
            condim=4,
            friction=[0.9, 0.9, 0.008, 0.0001, 0.0001],
            solref=[0.008, 1.0],
            # While the arm accelerates, what it holds creeps: contact forces are solved for an acceleration that the
            # servos' implicit damping then lowers. A stiffer friction direction halves the creep.
            solreffriction=[0.004, 1.0],
            solimp=[0.95, 0.99, 0.0005, 0.5, 2.0],
        )


def _add_target(spec: mujoco.MjSpec) -> None:
    """Add the axes that mark a wanted tool pose: x red, y green, z blue."""
    target = spec.worldbody.add_body(name="target", pos=PARKED[0])
    for axis, colour in enumerate(((0.9, 0.1, 0.1), (0.1, 0.75, 0.1), (0.15, 0.3, 0.95))):
        end = [0.0, 0.0, 0.0]
        end[axis] = 0.09
        target.add_geom(
            name=f"target_{axis}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, *end],
            size=[0.004, 0, 0],
            rgba=[*colour, 0.9],
            contype=0,
            conaffinity=0,
            group=1,
            mass=0.0,
        )


def _add_touch_sensors(spec: mujoco.MjSpec, arm: Arm, first: str, root: str, scene: str) -> None:
    """Count contacts: of the arm with anything and what it must not touch, of the robot with itself, of the gripper.

    Args:
        first: the body that the arm begins with; all behind it is the arm.
        root: the body that the robot begins with.
        scene: the body that the arm must not touch.
    """
    tree, one = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY
    gripper = arm.gripper.body if arm.gripper else first
    pairs = [
        ("touch_any", first, None, None),
        ("touch_table", first, one, scene),
        ("touch_self", root, tree, root),
        *((f"touch_object_{number}", gripper, one, f"object_{number}") for number in range(MAX_OBJECTS)),
    ]
    for name, subtree, kind, other in pairs:
        reference = {} if kind is None else {"reftype": kind, "refname": other}
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=tree,
            objname=subtree,
            intprm=[1, 0, 1],  # data: found; reduce: none; num: one slot
            **reference,
        )


def _add_fixture(spec: mujoco.MjSpec, root: str, number: int, shape: Shape) -> None:
    """Add something immovable to lean on, and the sensor of the force between it and the arm."""
    name, half, box = f"fixture_{number}", shape.height / 2, shape.kind == "box"
    body = spec.worldbody.add_body(
        name=name, pos=[shape.x, shape.y, half], quat=[math.cos(shape.yaw / 2), 0, 0, math.sin(shape.yaw / 2)]
    )
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX if box else mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[shape.size_x, shape.size_y, half] if box else [shape.size_x, half, 0],
        contype=TABLE_BIT,
        conaffinity=0,
        rgba=[0.62, 0.66, 0.70, 1.0],
    )
    spec.add_sensor(
        name=f"force_{name}",
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname=name,
        reftype=mujoco.mjtObj.mjOBJ_XBODY,
        refname=root,
        intprm=[2, 3, 1],  # data: force; reduce: net force, in the world frame; num: one slot
    )


def set_home(model: mujoco.MjModel, arm: Arm) -> None:
    """Write the state that a reset leads to: the arm at home, no object on the table."""
    dof, grip = len(arm.chain.joints), arm.gripper
    joints = (*arm.chain.joints, *(grip.joints if grip else ()))
    for name, value in zip(joints, (*arm.home[:dof], *(grip.joints_at(arm.home[dof]) if grip else ())), strict=True):
        model.key_qpos[0, model.joint(name).qposadr[0]] = value


def _visual(
    body: mujoco.MjsBody,
    kind: str,
    position: tuple[float, ...],
    size: tuple[float, ...],
    *,
    name: str = "",
    material: str = "",
    group: int = 1,
) -> None:
    """Add a geometry that is seen and touches nothing."""
    body.add_geom(
        name=name,
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        pos=position,
        size=size,
        material=material,
        contype=0,
        conaffinity=0,
        group=group,
        mass=0.0,
    )


def _towards(position: tuple[float, ...], target: tuple[float, ...]) -> list[float]:
    """Return a camera's x and y axis, side by side, when it points from one point to another and stands upright."""
    ahead: NDArray[np.float64] = np.subtract(target, position)
    right = np.array([ahead[1], -ahead[0], 0.0]) / math.hypot(ahead[0], ahead[1])
    up = np.cross(right, ahead)
    return [*right, *(up / np.linalg.norm(up))]
