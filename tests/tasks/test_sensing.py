"""What is wrong with what tasks tell: as noisy, late and incomplete as it is set to be, and otherwise the truth."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.bodies.truth import ArmTruth, BaseTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.sensing import SensingConfig
from tests.cases import each_case

FPS = 10
WRONG = {"noise_m": 0.01, "delay_s": 0.2, "dropout": 0.1}
TASKS: dict[str, tuple[Callable[..., Any], type, dict[str, Any]]] = {
    "pick": (PickTask, PickConfig, {"min_objects": 3}),
    "reach": (ReachTask, ReachConfig, {}),
    "navigate": (NavigateTask, NavigateConfig, {"arena": "turtlebot3_world"}),
    "avoid": (AvoidTask, AvoidConfig, {"arena": "turtlebot3_world", "trail": True}),
}


def make(name: str, n: int = 1, **sensing: float) -> Any:
    task, config, options = TASKS[name]
    return task(config(**options, sensing=SensingConfig(**sensing)), n, FPS)


def truth(task: Any, frame: int, n: int = 1) -> Any:
    """Return what is true in a frame: everything that can move moves on by a centimetre along x."""
    if Drive in task.needs:
        pose = np.tile([-2.0 + 0.01 * frame, -0.5, 0.0], (n, 1))
        return BaseTruth(pose, np.zeros(n, np.bool_))
    poses, no = np.zeros((n, MAX_OBJECTS, 7)), np.zeros(n, np.bool_)
    poses[..., 0], poses[..., 2], poses[..., 3] = 0.01 * frame, 0.04, 1.0
    return ArmTruth(poses[:, 0], poses, np.zeros(n), no, no, no, np.zeros((n, MAX_OBJECTS), np.bool_))


def told(name: str, frames: int, seed: int = 7, **sensing: float) -> np.ndarray:
    """Return what a task tells in the frames of an episode, shape (frames, things, fields)."""
    task = make(name, **sensing)
    task.begin(np.array([0]), [task.sample(seed)])
    rows = []
    for frame in range(frames):
        rows.append(task.environment_state(truth(task, frame))[0])
        assert np.array_equal(task.environment_state(truth(task, frame))[0], rows[-1]), "asked twice in a frame"
        task.judge(truth(task, frame), np.ones(1, np.bool_))
    return np.array(rows).reshape(frames, MAX_OBJECTS if name == "pick" else 1, -1)


POSITIONS = {"pick": [3, 4, 5], "reach": [0, 1, 2], "navigate": [0, 1]}


@each_case("name", POSITIONS)
def test_noise_is_on_positions_only_and_as_large_as_it_is_set_to_be(name: str) -> None:
    true, said = told(name, 300), told(name, 300, noise_m=0.004)
    present = true[:, :, 0] > 0 if name == "pick" else np.ones(true.shape[:2], np.bool_)
    off = (said - true)[present]
    assert off[:, POSITIONS[name]].std() == pytest.approx(0.004, rel=0.1)
    assert abs(off[:, POSITIONS[name]].mean()) < 0.001
    assert not np.delete(off, POSITIONS[name], axis=1).any()
    assert np.array_equal(said[~present], true[~present])


@pytest.mark.law
@each_case("name", TASKS)
def test_what_is_late_was_true_some_frames_before(name: str) -> None:
    true, said = told(name, 30), told(name, 30, delay_s=0.5)
    if name != "avoid":  # which cells were visited is always of now
        assert np.array_equal(said[5:], true[:-5])
        assert np.array_equal(said[:5], np.broadcast_to(true[0], (5, *true[0].shape)))
    assert np.array_equal(said, true) == (name == "reach"), "a target stays where it is"


def test_an_object_that_is_missing_is_left_out() -> None:
    true, said = told("pick", 400), told("pick", 400, dropout=0.25)
    gone = (true[:, :, 0] > 0) & (said[:, :, 0] == 0)
    assert gone.sum() / (true[:, :, 0] > 0).sum() == pytest.approx(0.25, abs=0.04)
    nothing = [float(name == "qw") for name in OBJECT_FIELDS]
    assert (said[gone] == nothing).all()
    assert np.array_equal(said[~gone], true[~gone])


def test_of_what_is_always_there_the_last_is_told_again() -> None:
    true, said = told("navigate", 400), told("navigate", 400, dropout=0.25)
    is_new = (said == true).all(axis=(1, 2))
    assert is_new[0]
    assert is_new.mean() == pytest.approx(0.75, abs=0.06)
    for frame in np.flatnonzero(~is_new):
        assert np.array_equal(said[frame], said[frame - 1])
    assert (told("navigate", 20, dropout=1.0) == true[0]).all()


def test_the_trail_is_drawn_around_a_wrong_pose_on_true_ground() -> None:
    """Around the pose of before, the robot has been where it has not been yet around the present one."""
    true = told("avoid", 120).reshape(120, 16, 8)
    assert not true[60, 0, 1:].any(), "ahead of it nothing was visited"
    late = told("avoid", 120, delay_s=8.0).reshape(120, 16, 8)
    assert late[60, 0, 1], "it stands half a metre ahead of where it takes itself to be"
    noisy = told("avoid", 120, noise_m=0.3).reshape(120, 16, 8)
    assert 0.02 < (noisy != true).mean() < 0.5
    assert set(np.unique(noisy)) == {0.0, 1.0}


@each_case("name", TASKS)
def test_how_many_run_side_by_side_and_when_they_begin_changes_nothing(name: str) -> None:
    alone, beside = told(name, 12, **WRONG), make(name, 3, **WRONG)
    beside.begin(np.arange(3), [beside.sample(seed) for seed in (1, 2, 3)])
    running = np.array([True, False, True])
    for frame in range(5):
        beside.environment_state(truth(beside, frame, 3))
        beside.judge(truth(beside, frame, 3), running)
    beside.begin(np.array([1]), [beside.sample(7)])
    for frame in range(12):
        said = beside.environment_state(truth(beside, frame, 3))[1]
        assert np.array_equal(said, alone[frame].ravel())
        beside.judge(truth(beside, frame, 3), np.ones(3, np.bool_))
        if frame == 6:  # another episode begins, and everybody is asked again
            beside.begin(np.array([0]), [beside.sample(4)])
            assert np.array_equal(beside.environment_state(truth(beside, frame + 1, 3))[1], alone[frame + 1].ravel())


def test_where_nothing_is_told_nothing_can_be_wrong_with_it() -> None:
    with pytest.raises(ConfigError, match=r"task.trail is false.*--task.trail=true"):
        AvoidConfig(sensing=SensingConfig(noise_m=0.1))
