"""The model that a world simulates: a base among obstacles that each simulation places, or an arm on a table.

An arm on a base has the obstacles, and objects to take from them.
"""

import math
from collections.abc import Sequence

from bhd_lerobot.bodies.body import Arm, Body, Shape
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.backdrop import add_backdrop
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.table_stage import add_mobile_arm, add_options, add_table_stage, set_home

# Obstacles that one simulation can have. All simulations of a batch share one model, so the number is fixed; a pool
# geometry that a simulation does not use is parked far below the floor, where the broad phase drops it at once.
POOL_SIZE = 32
PARKED_Z = -100.0
PARKED_GROUP = 5  # neither the range finder nor the camera sees this group

_FLOOR_BIT, _SCENE_BIT = 1, 2
_PLACED = ("obstacle_", "object_")  # how the names of geometries begin that simulations place themselves


def build_model(
    body: Body, physics_hz: int, pool_size: int = POOL_SIZE, fixtures: Sequence[Shape] = ()
) -> mujoco.MjModel:
    """Compile the model.

    Args:
        physics_hz: physics steps a second [Hz].
    """
    try:
        spec = mujoco.MjSpec.from_string(body.mjcf)
    except ValueError as error:
        raise ConfigError(f"The MJCF of body {body.name!r} is not valid: {error}") from error
    spec.option.timestep = 1.0 / physics_hz
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    try:
        if body.drive is not None:
            _add_arena_stage(spec, body, body.drive.touch_sensor, pool_size)
            if body.arm is not None:
                add_mobile_arm(spec, body.root, body.arm)
        else:
            add_table_stage(spec, body.root, body.need(Arm), fixtures)
        model = spec.compile()
    except ValueError as error:
        is_ours = "repeated name" in str(error)
        hint = " Rename it in the file of the robot: it is a name of our scene." if is_ours else ""
        raise ConfigError(f"The MJCF of body {body.name!r} does not compile: {error}.{hint}") from error
    if body.arm is not None:
        set_home(model, body.arm)
    # The compiler marks geometries that have the orientation of their body, and the engine then leaves theirs out of
    # account: obstacles would all stand along the axes, whatever orientation a simulation gives them.
    for index in range(model.ngeom):
        if model.geom(index).name.startswith(_PLACED):
            model.geom_sameframe[index] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return model


def _add_arena_stage(spec: mujoco.MjSpec, body: Body, touch_sensor: str, pool_size: int) -> None:
    """Add what stands around a base, and the sensor of its touches."""
    add_options(spec)
    _add_stage(spec)
    _add_pool(spec, pool_size)
    # Behind and above, as far as a room's walls are still seen; it moves with the robot and does not turn.
    root = spec.body(body.root)
    if root is None:
        raise ConfigError(f"The model of {body.name!r} has no body {body.root!r}.")
    root.add_camera(
        name="follow", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=[0, -0.7, 1.4], xyaxes=[1, 0, 0, 0, 0.894, 0.447],
        fovy=46,
    )  # fmt: skip
    spec.add_sensor(
        name=touch_sensor,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname=body.root,
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname="scene",
        intprm=[1, 0, 1],  # data: found; reduce: none; num: one slot
    )


def _add_stage(spec: mujoco.MjSpec) -> None:
    """Add floor, sky, light and the cameras that show the scene from outside."""
    add_backdrop(
        spec,
        sky=((0.78, 0.86, 0.95), (0.95, 0.97, 1.0)),
        floor=((0.80, 0.80, 0.78), (0.72, 0.72, 0.70)),
    )
    spec.add_material(name="stage_obstacle", rgba=[0.80, 0.55, 0.30, 1.0], specular=0.1)
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        # The third is the edge of the squares that the plane is drawn in: at 0.1 m they took a software renderer three
        # quarters of the time of a small image, and at 2 m the image is the same.
        size=[20, 20, 2],
        material="stage_floor",
        contype=_FLOOR_BIT,
        conaffinity=0,
        # One sliding contact for each wheel needs no torsional or rolling friction.
        condim=3,
        friction=[0.9, 0.005, 0.0001],
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 6], dir=[-0.3, 0.2, -1], diffuse=[0.7] * 3
    )
    spec.visual.headlight.ambient = [0.45] * 3
    spec.visual.headlight.diffuse = [0.35] * 3
    # Near and far planes are multiples of the extent; left to MuJoCo it would span to the parked obstacles.
    spec.stat.extent = 4.0
    spec.visual.map.znear = 0.002
    # Shadows and multi-sampling off: with a software renderer a frame costs twenty times as much with them.
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.worldbody.add_camera(name="overview", pos=[0, -3.6, 6.4], xyaxes=[1, 0, 0, 0, 0.87, 0.49], fovy=46)


def _add_pool(spec: mujoco.MjSpec, pool_size: int) -> None:
    """Add the obstacles' pool on one static body, so that one contact sensor sees every touch with the scene."""
    pool = spec.worldbody.add_body(name="scene")
    for index in range(pool_size):
        pool.add_geom(
            name=f"obstacle_{index:03d}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.01, 0.01, 0.01],
            pos=[0, 0, PARKED_Z],
            material="stage_obstacle",
            contype=_SCENE_BIT,
            group=PARKED_GROUP,
            conaffinity=0,
        )


def shape_fields(shape: Shape) -> tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    """Return MuJoCo's type, size (3), position (3), quaternion wxyz (4) and bounding radius of a shape."""
    half = shape.height / 2
    position = (shape.x, shape.y, half)
    if shape.kind == "cylinder":
        size = (shape.size_x, half, 0.0)
        return int(mujoco.mjtGeom.mjGEOM_CYLINDER), size, position, (1.0, 0.0, 0.0, 0.0), math.hypot(shape.size_x, half)
    quaternion = (math.cos(shape.yaw / 2), 0.0, 0.0, math.sin(shape.yaw / 2))
    size = (shape.size_x, shape.size_y, half)
    return int(mujoco.mjtGeom.mjGEOM_BOX), size, position, quaternion, math.hypot(*size)
