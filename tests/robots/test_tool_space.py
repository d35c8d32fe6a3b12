"""Tool poses as actions: the numbers, and arms that follow them or say why not."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.tabletop import TableScene, Variation
from bhd_lerobot.bodies.ur import JOINTS
from bhd_lerobot.control.commands import Chunk
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.messages import Limit, Mode, Reason
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.brain import ConfiguredBrain, Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.parts.arm import pose_matrices
from bhd_lerobot.robots.parts.names import TOOL_NAMES
from bhd_lerobot.robots.ur import UR5
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import episode_seed
from tests.cases import each_case

DOWN = [0.5, 0.1, 0.3, 0.0, 1.0, 0.0, 0.0]


def test_quaternions_near_unit_length_are_normalised_and_others_refused() -> None:
    unit = np.array([0.5, 0.5, -0.5, 0.5])
    expected, _ = pose_matrices(np.array([0, 0, 0, *unit]))
    for length in (0.81, 0.999, 1.0, 1.19):
        matrix, problem = pose_matrices(np.array([0, 0, 0, *(length * unit)]))
        assert problem is None
        assert np.allclose(matrix, expected, atol=1e-12)
    for length in (0.0, 0.79, 1.21, 1e9, np.nan, np.inf):
        _, problem = pose_matrices(np.array([0, 0, 0, *(length * unit)]))
        assert problem is not None
        assert "length" in problem
        assert "must be near 1" in problem


def test_the_observed_tool_pose_is_that_of_the_observed_joints_with_their_noise() -> None:
    arm = Simulation(UR5Config(tool_pose=True), 2, threads=1)
    noisy = replace(Variation(), sensor_noise=0.01)
    scenes = [TableScene("empty", (), arm.body.arm.home, variation=variation) for variation in (Variation(), noisy)]
    arm.reset(np.arange(2), scenes, [0, 1])
    arm.step(np.repeat(arm.cerebellum.command[:1], 2, axis=0))
    state = arm.observe().state
    names = list(arm.observation_names)
    assert names[-7:] == list(TOOL_NAMES[:-1])
    assert state.shape == (2, len(names))
    joints = state[:, [names.index(f"{joint}.pos") for joint in JOINTS]]
    assert np.allclose(state[:, -7:], pose_vectors(arm.kinematics.tool(joints)), atol=1e-12)
    assert np.allclose(state[0, -7:-4], arm.truth().tool_pose[0, :3], atol=1e-3)
    assert np.abs(state[1, -7:-4] - arm.truth().tool_pose[1, :3]).max() > 1e-3
    assert list(UR5(UR5Config(tool_pose=True)).observation_features) == names


@pytest.fixture(scope="module")
def simulation():
    return Simulation(UR5Config(action_space="tool"), 3, threads=1)


def start(simulation: Simulation) -> np.ndarray:
    """Put all arms home; return the action that keeps them there."""
    ids = np.arange(simulation.n)
    scenes = [TableScene("empty", (), simulation.body.arm.home)] * simulation.n
    simulation.reset(ids, scenes, [0] * simulation.n)
    command = simulation.cerebellum.command
    return np.concatenate([pose_vectors(simulation.kinematics.tool(command[:, :6])), command[:, 6:]], axis=1)


def test_tool_actions_reach_their_poses(simulation) -> None:
    action = start(simulation)
    pose = simulation.truth().tool_pose
    assert np.allclose(action[:, :3], pose[:, :3], atol=1e-3)
    assert np.abs((pose[:, 3:] * action[:, 3:7]).sum(axis=1)).min() > 1 - 1e-5
    goal = action.copy()
    goal[:, :3] += [[0.05, 0.0, -0.05], [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]]
    goal[2, 3:7] = pose_vectors(
        pose_matrices(action[2, :7])[0]
        @ np.block([[Rotation.from_euler("z", 0.5).as_matrix(), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    )[3:]
    goal[:, 7] = 0.05
    for _ in range(40):
        report = simulation.step(goal)
        assert report.sent.accepted.all()
        assert not report.refusals
    assert np.allclose(report.applied, goal, atol=1e-6)
    pose = simulation.truth().tool_pose
    assert np.abs(pose[:, :3] - goal[:, :3]).max() < 1e-3
    assert np.abs((pose[:, 3:] * goal[:, 3:7]).sum(axis=1)).min() > 1 - 1e-5


def test_non_finite_poses_are_refused_and_nothing_moves(simulation) -> None:
    for column, value in itertools.product((0, 5, 7), (np.nan, np.inf)):
        before = start(simulation)
        action = before.copy()
        action[1, column] = value
        action[0, 2] += 0.02
        report = simulation.step(action)
        assert report.sent.accepted.tolist() == [True, False, True]
        assert np.array_equal(report.applied[1], before[1])
        assert report.mode[1] == Mode.HOLD


def test_an_arm_whose_poses_are_refused_stops_at_the_time_out_and_the_others_continue(simulation) -> None:
    action = start(simulation)
    for _ in range(10):
        action[:, 1] += 0.01
        moving = simulation.step(action)
    assert moving.mode.tolist() == [Mode.TRACKING] * 3
    action[0, 0] = 3.0  # three metres away
    action[1, 3:7] = 0.0
    action[2, 2] += 0.05
    for _ in range(15):
        report = simulation.step(action)
        assert report.sent.reasons.tolist() == [Reason.NO_POSTURE, Reason.NO_POSTURE, Reason.ACCEPTED]
    assert set(report.refusals) == {0, 1}
    assert "length 0" in report.refusals[1]
    assert report.mode.tolist() == [Mode.HOLD, Mode.HOLD, Mode.TRACKING]
    assert report.applied[2, 2] == pytest.approx(action[2, 2], abs=1e-4)
    assert not report.limits[0] & Limit.NON_FINITE


@pytest.mark.thorough
def test_a_tool_that_turns_on_the_spot_stays_on_the_spot() -> None:
    """Turned far enough about any axis the arm comes to a singular posture, and then to another branch.

    To jump there, the tool would leave its place by hundreds of millimetres, into the table. It is refused instead, in
    words and in the recorded flags, and the arm holds the last pose; the stream back is taken again.
    """
    axes = [sign * np.array(axis) for axis in itertools.product((0, 1), repeat=3) if any(axis) for sign in (1, -1)]
    simulation = Simulation(UR5Config(action_space="tool"), len(axes), threads=1)
    action = start(simulation)
    place = action[:, :3].copy()
    first = [pose_matrices(row[:7])[0][:3, :3] for row in action]
    refused, off = np.zeros(len(axes), np.bool_), np.zeros(len(axes))
    frames = list(range(150))  # 3.6 rad at 0.6 rad/s
    for frame in (*frames, *frames[::-1]):
        for sim, (axis, rotation) in enumerate(zip(axes, first, strict=True)):
            turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * 0.6 * frame / simulation.rates.fps)
            action[sim, 3:7] = Rotation.from_matrix(turn.as_matrix() @ rotation).as_quat(scalar_first=True)
        report = simulation.step(action)
        off = np.maximum(off, np.linalg.norm(simulation.truth().tool_pose[:, :3] - place, axis=1))
        now = report.sent.reasons == Reason.NO_POSTURE
        refused |= now
        assert np.array_equal(now, (report.limits & Limit.POSTURE) > 0)
        assert set(report.refusals) == set(np.flatnonzero(now).tolist())
    assert refused.sum() >= 3
    assert off.max() < 0.03
    assert not now.any()  # where it began
    assert np.allclose(report.applied[:, :3], place, atol=1e-3)


@pytest.mark.thorough
def test_the_last_joint_does_not_unwind_by_a_turn() -> None:
    simulation = Simulation(UR5Config(action_space="tool"), 1, threads=1)
    action = start(simulation)
    rotation = pose_matrices(action[0, :7])[0][:3, :3]
    last, most = simulation.cerebellum.command[0, 5], 0.0
    for frame in range(700):  # 11 rad about the tool's own axis: beyond the joint's range
        turned = rotation @ Rotation.from_rotvec([0, 0, 0.4 * frame / 25]).as_matrix()
        action[0, 3:7] = Rotation.from_matrix(turned).as_quat(scalar_first=True)
        report = simulation.step(action)
        now = simulation.cerebellum.command[0, 5]
        most, last = max(most, abs(now - last)), now
    assert most < 0.1
    assert report.sent.reasons.tolist() == [Reason.NO_POSTURE]
    assert "wrist_3 would have to turn by" in report.refusals[0]
    assert abs(last) > 6.2


def test_the_poses_of_a_chunk_follow_each_other() -> None:
    """Each is solved from the one before it, not from where the arm is now."""
    simulation = Simulation(UR5Config(action_space="tool"), 1, threads=1)
    action = start(simulation)
    before = simulation.cerebellum.command[0, :6].copy()
    rotation = pose_matrices(action[0, :7])[0][:3, :3]
    rows = []
    for frame in range(60):  # 2.4 rad, in steps of 0.04
        turned = Rotation.from_matrix(rotation @ Rotation.from_rotvec([0, 0, 0.04 * frame]).as_matrix())
        rows.append([[*action[0, :3], *turned.as_quat(scalar_first=True), action[0, 7]]])
    report = simulation.step(Chunk(np.array(rows)))
    assert report.sent.accepted.all()
    for _ in range(70):
        simulation.step(None)
    assert abs(abs(simulation.cerebellum.command[0, 5] - before[5]) - 0.04 * 59) < 0.02  # a brake at its end


@pytest.mark.thorough
def test_a_stream_whose_poses_were_refused_is_taken_again_only_near_to_the_tool() -> None:
    """Streams of 0.2 m/s that leave the workspace and come back to it elsewhere, and then to where they left it."""
    corners = ([(0.60, -0.79, 0.73), (-0.60, -0.22, 0.22)], [(0.89, 0.51, 0.39), (-0.14, 0.68, 0.05)])
    simulation = Simulation(UR5Config(action_space="tool"), len(corners), threads=1)
    action, step = start(simulation), 0.2 / simulation.rates.fps
    paths, frames = [], 0
    for place, ends in zip(action[:, :3], corners, strict=True):
        legs, begin = [], place.copy()
        for end in ends:
            count = int(np.linalg.norm(np.subtract(end, begin)) / step)
            legs.append(begin + np.arange(1, count + 1)[:, None] / count * (end - begin))
            begin = np.array(end)
        there = np.concatenate(legs)
        paths.append(np.concatenate((there, there[::-1])))
        frames = max(frames, len(paths[-1]))
    tool, taken, was_refused = simulation.truth().tool_pose[:, :3], [False] * len(paths), np.zeros(len(paths), np.bool_)
    for frame in range(frames):
        for sim, path in enumerate(paths):
            action[sim, :3] = path[min(frame, len(path) - 1)]
        before = tool
        report = simulation.step(action)
        tool = simulation.truth().tool_pose[:, :3].copy()
        refused = report.sent.reasons == Reason.NO_POSTURE
        assert np.linalg.norm(tool - before, axis=1).max() < 0.8 / simulation.rates.fps
        for sim in np.flatnonzero(was_refused & ~refused):
            assert np.linalg.norm(action[sim, :3] - before[sim]) < 0.11
            taken[sim] = True
        for sim, path in enumerate(paths):
            assert np.linalg.norm(path - tool[sim], axis=1).min() < 0.06
        was_refused = refused
    assert all(taken)
    assert not refused.any()
    np.testing.assert_allclose(tool, [path[-1] for path in paths], atol=2e-3)


def test_after_refusals_the_first_pose_has_to_be_near_to_the_tool() -> None:
    """Without a refusal a pose may be further away, and in a fast stream a single refusal does not end it."""
    simulation = Simulation(UR5Config(action_space="tool"), 1, threads=1)

    def answer(y: float, x: float = 0.0) -> tuple[int, str]:
        report = simulation.step(home + np.array([[x, y, 0, 0, 0, 0, 0, 0]]))
        return int(report.sent.reasons[0]), report.refusals.get(0, "")

    home, ahead = start(simulation), 0.0
    for _ in range(20):
        assert answer(0.15) == (Reason.ACCEPTED, "")
    for _ in range(20):
        assert answer(0.15, x=3.0)[0] == Reason.NO_POSTURE
    for far in (0.12, -0.12, 0.25):
        reason, message = answer(0.15 + far)
        assert reason == Reason.NO_POSTURE
        assert message.startswith(
            f"The poses before were refused, and this one is {abs(far):.3f} m from where the tool"
        )
    assert answer(0.15 - 0.09) == (Reason.ACCEPTED, "")
    assert answer(0.15 + 0.09) == (Reason.ACCEPTED, "")
    assert answer(0.15, x=3.0)[0] == Reason.NO_POSTURE
    start(simulation)  # another episode: in it nothing was refused yet
    assert answer(0.15) == (Reason.ACCEPTED, "")
    start(simulation)
    for frame in range(1, 8):  # 1 m/s, from rest
        ahead = max(ahead, home[0, 1] + 0.04 * frame - simulation.truth().tool_pose[0, 1])
        reason, _ = answer(0.04 * frame, x=3.0 * (frame == 6))
        assert reason == (Reason.NO_POSTURE if frame == 6 else Reason.ACCEPTED)
    assert ahead > 0.12


class Recorded(ConfiguredBrain):
    """Gives the actions of episodes, each in the simulation of its number, and then the last of them for ever."""

    name = "recorded"
    uses_privileged_state = False

    def __init__(self, actions: list[np.ndarray]) -> None:
        super().__init__(None)
        self._actions, self._frame = actions, 0

    def act(self, observation: Observation) -> np.ndarray:
        self._frame += 1
        return np.array([rows[min(self._frame, len(rows)) - 1] for rows in self._actions])

    def bind(self, robot: RobotFeatures) -> None:
        pass


@pytest.mark.law
@each_case("off", [0.0, 0.002])
@each_case("config", [UR5Config, SO101Config])
def test_what_the_rule_was_recorded_to_do_reaches_the_target_as_setpoints_too(config: type, off: float) -> None:
    """Also if it is a little off, as a policy's is: by 2 mm and half a degree, less than counts as reached.

    An arm with five joints cannot be turned as that asks for, and is not to change its posture for it.
    """
    arm = Simulation(config(action_space="tool", tool_pose=True), 6, threads=1)
    task = ReachTask(ReachConfig(duration_s=6.0), arm.n, arm.config.fps, arm.body)
    specs = [EpisodeSpec(number, episode_seed(0, number, "train")) for number in range(arm.n)]
    shown = list(EpisodeLoop(arm, task, ReachBrain()).run(specs))
    assert all(episode.outcome.success for episode in shown)
    rng, actions = np.random.default_rng(0), []
    for episode in shown:
        rows = episode.columns[keys.ACTION].astype(np.float64)
        way, turn = (one / np.linalg.norm(one) for one in rng.normal(size=(2, 3)))
        rows[:, :3] += off * way
        rotation = Rotation.from_rotvec(off * 5 * turn) * Rotation.from_quat(rows[:, 3:7], scalar_first=True)
        rows[:, 3:7] = rotation.as_quat(scalar_first=True)
        actions.append(rows)
    for episode in EpisodeLoop(arm, task, Recorded(actions)).run(specs):
        assert episode.outcome.success, episode.outcome
        assert not (episode.columns[keys.LIMITS] & int(Limit.POSTURE)).any()
