"""The fetch task on made-up truth."""

from dataclasses import replace

import numpy as np
import pytest

from bhd_lerobot.bodies.fetch_scene import FetchScene
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, TableScene
from bhd_lerobot.bodies.truth import MobileArmTruth
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.fetch import ENVIRONMENT, FetchConfig, FetchTask
from bhd_lerobot.tasks.task import Event, outcomes_of
from tests.tasks.support import Judged

BODY = turtlebot3_manipulation()
FPS = 10
CLEAN = dict.fromkeys(("touched", "arm_on_table", "arm_on_object", "self_contact"), False)


def made(n: int = 1, **options: float) -> FetchTask:
    return FetchTask(FetchConfig(**options), n, FPS, BODY)


def truth(
    at: np.ndarray, base: tuple[float, float, float] = (0.0, 0.0, 0.0), *, gripped: bool = False, **flags: bool
) -> MobileArmTruth:
    """What is true of one robot with an object at a place in the world frame."""
    x, y, yaw = base
    cos, sin = np.cos(yaw), np.sin(yaw)
    poses = np.zeros((1, MAX_OBJECTS, 7))
    dx, dy = at[0] - x, at[1] - y
    poses[:, :, 3] = 1.0
    poses[0, 0, :3] = cos * dx + sin * dy, cos * dy - sin * dx, at[2]
    fingers = np.zeros((1, MAX_OBJECTS), np.bool_)
    fingers[0, 0] = gripped
    return MobileArmTruth(
        base_pose_in_world=np.array([base]),
        tool_pose=np.zeros((1, 7)),
        object_poses=poses,
        opening=np.zeros(1),
        fingers_on_object=fingers,
        **{name: np.array([value]) for name, value in (CLEAN | flags).items()},
    )


def ends(scene: FetchScene) -> tuple[np.ndarray, np.ndarray]:
    """Where the middle of the object is at the start, and on its place."""
    up = np.array((0.0, 0.0, scene.objects[0].height / 2))
    return tuple(np.array((stand.x, stand.y, stand.height)) + up for stand in (scene.pick, scene.place))


@pytest.mark.law
@pytest.mark.parametrize("seed", range(5))
def test_success_is_the_object_at_its_place_let_go_of_and_at_rest(seed: int) -> None:
    task = made(hold_s=0.5)
    scene = task.sample(seed)
    start, place = ends(scene)
    judged = Judged(task, [scene])
    for share in np.linspace(0.0, 1.0, 11):  # carried there
        judged.judge(truth(start + share * (place - start) + (0, 0, 0.05), (share, -share, 3 * share), gripped=True))
    for at in (np.add(place, (0, 0, 0.05)), np.add(place, (0.06, 0, 0)), place):
        judged.judge(truth(at))
    for _ in range(20):
        judged.judge(truth(place, gripped=True))  # held there it is not there
    assert judged.running.all()
    for _ in range(10):
        judged.judge(truth(np.add(place, (0.02, -0.02, 0.002)), (0.3, 0.2, 1.0)))
    assert judged.events.tolist() == [Event.SUCCESS]
    outcome = judged.outcome()
    assert outcome.success
    assert outcome.score == judged.rewards[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("flags", "height", "event"),
    [
        ({"touched": True}, 0.0, Event.COLLISION),
        ({"arm_on_table": True}, 0.0, Event.COLLISION),
        ({"arm_on_object": True}, 0.0, Event.COLLISION),
        ({"self_contact": True}, 0.0, Event.COLLISION),
        ({}, -0.14, Event.DROPPED),
        ({}, 0.0, Event.TIMEOUT),
    ],
)
def test_failures(flags: dict[str, bool], height: float, event: Event) -> None:
    task = made(duration_s=2.0)
    scene = task.sample(0)
    start, place = ends(scene)
    judged = Judged(task, [scene])
    halfway = (start + place) / 2 + (0, 0, height)
    while judged.running.any():
        judged.judge(truth(halfway, gripped=height == 0.0, **flags))
    assert judged.events.tolist() == [event]
    assert judged.frames[0] == (20 if event == Event.TIMEOUT else 1)
    assert not judged.outcome().success
    assert judged.outcome().score == pytest.approx(0.45, abs=0.01)


@pytest.mark.law
def test_what_is_told_is_in_the_frame_of_the_robot() -> None:
    task = made()
    scene = task.sample(3)
    start, place = ends(scene)
    task.begin(np.arange(1), [scene])
    x, y, yaw = base = (0.4, -0.3, 2.0)
    told = dict(zip(ENVIRONMENT, task.environment_state(truth(start, base))[0].tolist(), strict=True))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for name, at, direction in (("object_0", start, scene.pick.yaw), ("place", place, scene.place.yaw)):
        back = turn @ (told[f"{name}_x"], told[f"{name}_y"]) + (x, y)
        np.testing.assert_allclose(back, at[:2], atol=1e-12)
        ahead = turn @ (told[f"{name}_ahead_cos"], told[f"{name}_ahead_sin"])
        np.testing.assert_allclose(ahead, (np.cos(direction), np.sin(direction)), atol=1e-12)
    assert told["place_z"] == scene.place.height
    assert told["object_0_height"] == scene.objects[0].height


def test_a_scene_without_an_object_is_refused_and_some_outcomes_never_happen() -> None:
    task = made()
    for scene in (TableScene("empty", (), BODY.arm.home), replace(task.sample(0), objects=(), target_object=None)):
        with pytest.raises(ConfigError, match="no object to fetch"):
            task.begin(np.arange(1), [scene])
    assert "dropped" in outcomes_of("fetch", BODY)
    assert not {"stuck", "wrong_object", "unreachable"} & set(outcomes_of("fetch", BODY))
