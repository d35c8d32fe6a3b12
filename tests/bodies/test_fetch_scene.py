"""Arenas to fetch things in: equal for equal seeds, and the robot can do what they ask for."""

import math

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import CLEARANCE
from bhd_lerobot.bodies.fetch_scene import FetchScene, make_fetch_scene
from bhd_lerobot.bodies.scenes import scene_from_json, scene_to_json
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.policies.manipulation.grasp import pointing_ahead

BODY = turtlebot3_manipulation()
SCENES = [make_fetch_scene(seed, BODY) for seed in range(40)]


def test_equal_seeds_give_equal_scenes_and_json_keeps_them() -> None:
    for seed, scene in enumerate(SCENES):
        assert make_fetch_scene(seed, BODY) == scene
        text = scene_to_json(scene)
        again = scene_from_json(text)
        assert isinstance(again, FetchScene)
        assert (again.objects, again.pick, again.place, again.arena.shapes) == (
            scene.objects,
            scene.pick,
            scene.place,
            scene.arena.shapes,
        )
        assert scene_to_json(again) == text
    assert len({scene_to_json(scene) for scene in SCENES}) == len(SCENES)


@pytest.mark.law
@pytest.mark.parametrize("scene", SCENES, ids=map(str, range(len(SCENES))))
def test_the_robot_fits_everywhere_it_has_to_go_and_reaches_what_it_has_to(scene: FetchScene) -> None:
    arena, [thing] = scene.arena, scene.objects
    points, free = arena.reachable
    room = BODY.drive.radius + CLEARANCE
    assert arena.clearance(np.array(arena.start[:2])) >= room
    kinematics = ArmKinematics(BODY.arm.chain, BODY.arm.limits)
    (near, _), (far, _) = BODY.arm.workspace.table
    for stand in (scene.pick, scene.place):
        before = np.array(stand.before(0.42)[:2])
        assert (free & (np.hypot(*(points - before).transpose(2, 0, 1)) < 0.08)).any()
        # From where the arm reaches the spot the hull is not in the stand, which the scanner sees.
        front = max(end for _, end, _ in BODY.drive.outline)
        at = stand.before((near + far) / 2 - front)
        assert arena.clearance(np.array(at[:2])) > 0.01
        assert stand.height > 0.132
        pose = pointing_ahead((near + far) / 2, 0.0, stand.height + 0.06, 0.0).matrix()
        assert kinematics.solve(pose, np.array(BODY.arm.home[:4])).code == 0
    assert math.hypot(thing.x - scene.pick.x, thing.y - scene.pick.y) == 0
    assert arena.clearance(np.array([thing.x, thing.y])) <= -max(thing.size_x, thing.size_y)  # it stands on something
    assert arena.clearance(np.array([scene.place.x, scene.place.y])) <= -0.04
    assert 2 * math.hypot(thing.size_x, thing.size_y) <= BODY.arm.gripper.max_opening
    assert thing.mass <= BODY.arm.payload
    for shape in arena.shapes[6:]:  # behind walls and stands
        for stand in (scene.pick, scene.place):
            assert math.hypot(shape.x - stand.x, shape.y - stand.y) > 0.25
    assert math.dist((scene.pick.x, scene.pick.y), (scene.place.x, scene.place.y)) > 0.5
