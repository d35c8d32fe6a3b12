"""Where the robot and what is around it were in every frame, for the views from above and from the side."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.apps.view.groups import names_of, scan_of
from bhd_lerobot.bodies.body import Arm, Drive
from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.state import Row

Arrays = dict[str, NDArray]
_AWAY_M = 10.0  # an object this high is absent: it floats out of sight
_BASE_STATE = 9  # numbers of a base's position: its pose, and two wheels


def scene_of(row: Row) -> dict[str, Any] | None:
    """Return what was around the robot, as it was recorded; None if nothing readable was."""
    try:
        scene = json.loads(row["bhd/scene"])
    except (KeyError, TypeError, ValueError):
        return None
    if not isinstance(scene, dict):
        return None
    if isinstance(arena := scene.get("arena"), dict):
        x, y, yaw = (float(scene["place"][name]) for name in ("x", "y", "yaw"))
        return {"kind": "arena", **arena, "goal": [x, y, yaw]}
    if "extent" in scene and "shapes" in scene:
        return {"kind": "arena", **scene}
    if "objects" in scene:
        return {"kind": "table", **scene, "colours": COLOURS}
    return None


def views_of(
    robot: str | None, features: Mapping[str, Any], columns: Mapping[str, NDArray]
) -> tuple[dict[str, Any], Arrays]:
    """Return what is known about the robot's place: a description, and arrays by name.

    Arrays of a base: ``base`` (frames, 3), x, y [m] and yaw [rad] in the world. Of an arm, in the base frame:
    ``capsules`` (frames, capsules, 6), the two ends [m] of each; ``tool`` (frames, 3) [m]; and ``objects``
    (frames, objects, 7), position [m] and unit quaternion w, x, y, z, NaN where there is none.
    """
    body = body_of(robot)
    observed = columns.get(keys.OBSERVATION_STATE)
    names = names_of(features[keys.OBSERVATION_STATE], observed.shape[1]) if observed is not None else []
    physics = columns.get(keys.PHYSICS_STATE)
    about: dict[str, Any] = {}
    arrays: Arrays = {}
    scan = scan_of(names)
    if scan is not None:
        lidar = body.lidar if body else None
        about["scan"] = {
            "column": keys.OBSERVATION_STATE,
            "first": scan[0],
            "beams": scan[1],
            "range_max": lidar.range_max if lidar else None,
            "x": lidar.ahead if lidar else 0.0,
        }
    arm, drive = (body.arm, body.drive) if body else (None, None)
    if arm is not None and drive is None and (joints := _joints(arm, names, observed, physics)) is not None:
        capsules = arm.chain.capsules
        hand = next(number for number, capsule in enumerate(capsules) if capsule.frame == len(arm.chain.joints))
        about["arm"] = {"radii": [capsule.radius for capsule in capsules], "hand": hand}
        arrays |= _arm(arm, *joints)
        if physics is not None and physics.shape[1] > _arm_state(arm):
            arrays["objects"] = _objects(arm, physics)
    elif drive is not None and physics is not None and physics.shape[1] > _BASE_STATE:
        about["base"] = {"from": "simulator", **_shape(drive)}
        w, x, y, z = physics[:, 3:7].T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        arrays["base"] = np.column_stack([physics[:, :2], yaw]).astype(np.float32)
    elif observed is not None and {"x.pos", "y.pos", "theta.pos"} <= set(names):
        about["base"] = {"from": "odometry", **_shape(drive)}
        arrays["base"] = observed[:, [names.index(name) for name in ("x.pos", "y.pos", "theta.pos")]]
    return about, arrays


def _shape(drive: Drive | None) -> dict[str, Any]:
    """Return how a base is drawn [m]; one that is not known is a box of 0.2 m."""
    if drive is None:
        return {"radius": 0.1, "height": 0.2, "outline": [(-0.1, 0.1, 0.07)]}
    return {"radius": drive.radius, "height": drive.height, "outline": drive.outline}


def _arm_state(arm: Arm) -> int:
    """Return how many numbers the position of an arm with a gripper of two fingers and of all objects has."""
    return len(arm.chain.joints) + 2 + 7 * MAX_OBJECTS


def _joints(
    arm: Arm, names: list[str], observed: NDArray | None, physics: NDArray | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return joint positions (frames, joints) and the gripper's opening (frames,), of the simulator if it is there."""
    dof = len(arm.chain.joints)
    if physics is not None and physics.shape[1] > _arm_state(arm):
        return physics[:, :dof].astype(np.float64), physics[:, dof : dof + 2].sum(axis=1).astype(np.float64)
    wanted = [f"{joint}.pos" for joint in arm.chain.joints]
    if observed is None or not set(wanted) <= set(names):
        return None
    opening = observed[:, names.index("gripper.pos")] if "gripper.pos" in names else np.zeros(len(observed))
    return observed[:, [names.index(name) for name in wanted]].astype(np.float64), opening.astype(np.float64)


def _arm(arm: Arm, joints: NDArray[np.float64], opening: NDArray[np.float64]) -> Arrays:
    chain = arm.chain
    kinematics = ForwardKinematics(chain)
    frames = kinematics.frames(joints)
    capsules = np.empty((len(joints), len(chain.capsules), 2, 3), np.float32)
    for number, capsule in enumerate(chain.capsules):
        frame = frames[:, capsule.frame]
        for end, point in enumerate((capsule.start, capsule.end)):
            local = np.tile(np.asarray(point, np.float64), (len(joints), 1))
            if capsule.name.startswith("finger"):  # drawn where the fingers are; the collision checks take them as open
                local[:, 1] = np.sign(point[1]) * (opening / 2 + capsule.radius)
            capsules[:, number, end] = np.einsum("fij,fj->fi", frame[:, :3, :3], local) + frame[:, :3, 3]
    tool = kinematics.tool(joints)[:, :3, 3]
    return {"capsules": capsules.reshape(len(joints), -1, 6), "tool": tool.astype(np.float32)}


def _objects(arm: Arm, physics: NDArray) -> NDArray[np.float32]:
    objects = (
        physics[:, len(arm.chain.joints) + 2 : _arm_state(arm)].reshape(len(physics), MAX_OBJECTS, 7).astype(np.float32)
    )
    objects[objects[..., 2] > _AWAY_M] = np.nan
    return objects
