"""The rules that say in every frame what to do, whoever brought the arm where it is."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.servo import PickServoBrain, PickServoConfig, ReachServoBrain
from bhd_lerobot.robots.parts.names import TOOL_NAMES
from bhd_lerobot.tasks.pick import ENVIRONMENT, PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Event, episode_seed
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case
from tests.policies.arm_desk import episodes
from tests.policies.perception.rig import states

POSE = tuple(f"target_{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
TOOL = {"action_space": "tool", "tool_pose": True}


def features(environment: tuple[str, ...]) -> RobotFeatures:
    return RobotFeatures(TOOL_NAMES, TOOL_NAMES, 25, environment, body=ur5())


def tools(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return tool poses in all directions, and openings, shape (n, 8)."""
    place = rng.uniform((0.2, -0.4, 0.02), (0.7, 0.4, 0.4), (n, 3))
    quaternion = Rotation.random(n, rng=rng).as_quat(scalar_first=True)
    return np.concatenate([place, quaternion, rng.uniform(0, 0.085, (n, 1))], axis=1)


def test_a_gripper_is_not_opened_wider_than_it_opens() -> None:
    with pytest.raises(ConfigError, match=r"brain.wider_m is 0.5; the gripper opens by 0.085 m"):
        pick(PickServoConfig(wider_m=0.5))


def pick(config: PickServoConfig | None = None) -> PickServoBrain:
    brain = PickServoBrain(config)
    brain.bind(features(ENVIRONMENT))
    return brain


@each_case(("randomised", "wider"), [(False, 0.0), (True, 0.016)])
def test_it_picks(randomised: bool, wider: float) -> None:
    config = PickConfig(order="random", randomisation=RandomisationConfig(enabled=randomised))
    seeds = [episode_seed(5, i, "train") for i in range(4)]
    done = episodes(PickServoBrain(PickServoConfig(wider_m=wider)), PickTask, config, seeds, n=4, **TOOL)
    assert [episode.outcome.event for episode in done] == [Event.SUCCESS] * 4


def test_it_reaches() -> None:
    seeds = [episode_seed(0, i, "train") for i in range(4)]
    done = episodes(ReachServoBrain(), ReachTask, ReachConfig(), seeds, **TOOL)
    assert sum(episode.outcome.success for episode in done) >= 3  # straight ways may lead through singularities


@each_case(("brain", "environment"), [(PickServoBrain(), ENVIRONMENT), (ReachServoBrain(), POSE)])
def test_steps_are_short_from_wherever_the_tool_is(brain: Any, environment: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    brain.bind(features(environment))
    state, config = tools(200, rng), brain.config
    told = states(200) if environment is ENVIRONMENT else tools(200, rng)[:, :7]
    action = brain.act(Observation(TOOL_NAMES, state, {}, told))
    way = np.linalg.norm(action[:, :3] - state[:, :3], axis=1)
    assert way.max() <= config.lead_m + 1e-9
    assert np.allclose(np.linalg.norm(action[:, 3:7], axis=1), 1)
    one, other = (Rotation.from_quat(values[:, 3:7], scalar_first=True) for values in (action, state))
    assert (one * other.inv()).magnitude().max() <= config.lead_rad + 1e-9
    # A network that learns quaternions as numbers needs the nearer of the two.
    assert ((action[:, 3:7] * state[:, 3:7]).sum(axis=1) >= 0).all()


def test_what_is_to_be_done_depends_on_nothing_but_what_is_seen() -> None:
    rng = np.random.default_rng(1)
    state, told = tools(60, rng), states(60)
    brain = pick()
    action = brain.act(Observation(TOOL_NAMES, state, {}, told))
    order = rng.permutation(60)
    assert np.array_equal(brain.act(Observation(TOOL_NAMES, state[order], {}, told[order])), action[order])
    # In which row an object is told of is of no account.
    rows = told.reshape(60, MAX_OBJECTS, -1)[:, rng.permutation(MAX_OBJECTS)].reshape(60, -1)
    assert np.allclose(brain.act(Observation(TOOL_NAMES, state, {}, rows)), action)


def test_a_known_error_of_the_camera_is_taken_away() -> None:
    error = [0.01, -0.02, 0.005]
    state, told = tools(60, np.random.default_rng(2)), states(60)
    wrong = told.reshape(60, MAX_OBJECTS, -1).copy()
    place = OBJECT_FIELDS.index("x")
    wrong[:, :, place : place + 3] += error * (wrong[:, :, :1] > 0)
    right = pick().act(Observation(TOOL_NAMES, state, {}, told))
    config = PickServoConfig(camera_error_m=error)
    seen = pick(config).act(Observation(TOOL_NAMES, state, {}, wrong.reshape(60, -1)))
    # The turn of the wrist follows from where the object seems to be.
    assert np.allclose(seen[:, :3], right[:, :3], atol=1e-6)


def test_it_opens_wider_only_where_there_is_room() -> None:
    rng = np.random.default_rng(5)
    told = states(200)
    state = tools(200, rng)
    state[:, 2] = 0.4  # above everything
    usual, wide = (pick(PickServoConfig(wider_m=more)) for more in (0.0, 0.016))
    openings = [brain.act(Observation(TOOL_NAMES, state, {}, told))[:, 7] for brain in (usual, wide)]
    more = openings[1] - openings[0]
    assert openings[1].max() <= MAX_OPENING + 1e-9
    alone = told.reshape(200, MAX_OBJECTS, -1)[:, 1, 0] < 0.5
    free = alone & (openings[1] < MAX_OPENING - 1e-9)
    assert np.allclose(more[free & (more > 0)], 0.016)
    # Neighbours in all directions, so near that wider fingers would stand in one: they are opened as they were.
    target = np.array([1, 1, 0, 0.5, 0, 0.04, 1, 0, 0, 0, 0.05, 0.05, 0.08, 1, 0, 0])
    ring = [(0.5 + 0.085 * np.cos(angle), 0.085 * np.sin(angle)) for angle in np.pi * np.arange(4) / 4]
    beside = [[1, 0, 0, x, y, 0.04, 1, 0, 0, 0, 0.05, 0.05, 0.08, 0, 1, 0] for x, y in ring]
    crowd = np.concatenate([target, *beside])[None]
    answers = [brain.act(Observation(TOOL_NAMES, state[:1], {}, crowd))[0, 7] for brain in (usual, wide)]
    assert answers[0] == answers[1] < MAX_OPENING


def test_without_an_object_or_a_target_it_stays_where_it_is() -> None:
    state = tools(5, np.random.default_rng(3))
    nothing = np.zeros((5, len(ENVIRONMENT)))
    unknown = states(5)
    unknown.reshape(5, MAX_OBJECTS, -1)[:, 0, 3:6] = np.nan
    for told in (nothing, unknown):
        assert np.allclose(pick().act(Observation(TOOL_NAMES, state, {}, told)), state)
    reach = ReachServoBrain()
    reach.bind(features(POSE))
    for told in (np.zeros((5, 7)), np.full((5, 7), np.nan)):
        assert np.allclose(reach.act(Observation(TOOL_NAMES, state, {}, told)), state)


def test_a_robot_that_takes_joint_positions_is_refused() -> None:
    joints = ("shoulder_pan.pos", "gripper.pos")
    with pytest.raises(ConfigError, match=r"--robot\.action_space=tool --robot\.tool_pose=true"):
        PickServoBrain().bind(RobotFeatures(joints, joints, 25, ENVIRONMENT))
