"""The rule of the fetch task: it fetches, and what it does when something goes wrong."""

import math

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals, ResultCode
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.fetch import FetchBrain, FetchBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.fetch import ENVIRONMENT, FetchConfig, FetchTask
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Event, episode_seed

BODY, FPS, EPISODES = turtlebot3_manipulation(), 20, 3
NAMES = (*BODY.arm.limits.names, "x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(360)))
FEATURES = RobotFeatures(NAMES, BODY.limits.names, FPS, ENVIRONMENT, BODY)
SPECS = [EpisodeSpec(number, episode_seed(7, number, "held_out")) for number in range(EPISODES)]
HOME = (*BODY.arm.home, 0.0, 0.0)


def run(n: int, specs: list[EpisodeSpec]) -> list[Episode]:
    config = TurtleBot3ManipulationConfig()
    loop = EpisodeLoop(Simulation(config, n), FetchTask(FetchConfig(), n, config.fps, config.body()), FetchBrain())
    return list(loop.run(specs, lambda: False))


@pytest.fixture(scope="module")
def fetched() -> list[Episode]:
    return run(EPISODES, SPECS)


def test_it_fetches_what_it_was_never_tuned_on(fetched: list[Episode]) -> None:
    assert [episode.outcome.event for episode in fetched] == [Event.SUCCESS] * EPISODES
    for episode in fetched:
        assert [result.code for _, result in episode.results] == [ResultCode.SUCCEEDED] * len(episode.results)
        # In frames that follow goals the base stands, and in the others the arm is held at home.
        applied = episode.columns["control.applied_action"]
        follows = np.zeros(episode.frames, np.bool_)
        for first, end in episode.goal_frames:
            follows[first:end] = True
        assert 0 < follows.sum() < episode.frames
        assert not applied[follows][:, 5:].any()
        np.testing.assert_allclose(applied[~follows][:, :4], np.tile(HOME[:4], ((~follows).sum(), 1)), atol=1e-5)


def test_an_episode_is_the_same_alone_as_among_others(fetched: list[Episode]) -> None:
    (alone,), among = run(1, SPECS[1:2]), fetched[1]
    assert alone.frames == among.frames
    assert alone.results == among.results
    for key in ("control.applied_action", "simulation.state"):
        np.testing.assert_array_equal(alone.columns[key], among.columns[key])


class Desk:
    """One robot without a simulator: what it sees is made up."""

    def __init__(self, **options: object) -> None:
        self.brain = FetchBrain(FetchBrainConfig(**options))
        self.brain.bind(FEATURES)
        self.brain.reset(np.arange(1), [0], 1, ["bring it"])
        self.opening, self.x, self.goal = BODY.arm.gripper.max_opening, 0.6, None

    def look(self, result: CommandResult | None = None) -> Goals:
        """Show the object straight ahead, and its place where it is."""
        state = np.full((1, len(NAMES)), 3.5)
        state[0, :7] = *HOME[:4], self.opening, 0.0, 0.0
        told = dict.fromkeys(ENVIRONMENT, 0.0) | dict.fromkeys(("object_0_present", "object_0_qw"), 1.0)
        told |= {"object_0_x": self.x, "object_0_z": 0.18, "object_0_ahead_cos": 1.0, "place_x": self.x}
        told |= {"place_z": 0.16, "place_ahead_cos": 1.0}
        told |= {f"object_0_{name}": size for name, size in (("length", 0.03), ("width", 0.03), ("height", 0.06))}
        values = np.array([[told[name] for name in ENVIRONMENT]])
        return self.brain.act(Observation(NAMES, state, {}, values, {0: [result]} if result else {}))

    def drive(self) -> None:
        """Let it drive, straight ahead and back, until it gives a goal."""
        for _ in range(600):
            command = self.look()
            if command.commands:
                [[self.goal]] = command.commands.values()
                return
            assert command.streamed.tolist() == [0]
            assert abs(command.setpoints[0, 6]) < 0.05
            self.x -= command.setpoints[0, 5] / FPS
        raise AssertionError("It never gave a goal.")

    def end(self, *, success: bool = True) -> BrainCommand | None:
        """Let its goal end; return the next one."""
        code = ResultCode.SUCCEEDED if success else ResultCode.UNREACHABLE
        command = self.look(CommandResult(self.goal.task_id, success, code, "no way"))
        self.goal = command.commands[0][0] if command.commands else None
        return self.goal


def test_it_takes_along_lines_and_comes_back_home() -> None:
    desk = Desk(camera_error_m=[0.01, 0.0, 0.0])
    desk.drive()
    above = desk.goal
    assert above.gripper == BODY.arm.gripper.max_opening
    forward = desk.end()
    assert forward.motion == "line"
    assert math.dist(above.target_pose.position, forward.target_pose.position) == pytest.approx(0.085)
    assert forward.target_pose.position[0] == pytest.approx(0.225, abs=0.006)
    assert desk.x == pytest.approx(0.235, abs=0.006)  # which is what it takes for 0.01 m too far
    closing = desk.end()
    assert (closing.target_pose, closing.joint_target, closing.gripper) == (None, None, 0.0)
    desk.opening = 0.03
    lift = desk.end()
    np.testing.assert_allclose(np.subtract(lift.target_pose.position, forward.target_pose.position), (0, 0, 0.05))
    home = desk.end()
    assert home.joint_target == BODY.arm.home[:4]
    assert desk.end() is None
    assert desk.brain.subtasks() == ["back off"]
    command = desk.look()
    np.testing.assert_allclose(command.setpoints[0], (*HOME[:4], 0.0, -0.1, 0.0))  # it holds on to it


@pytest.mark.parametrize("goal", ["missed", "refused"])
def test_it_lets_go_and_tries_again_and_gives_up(goal: str) -> None:
    desk = Desk(attempts=2)
    for _ in range(2):
        desk.drive()
        if goal == "missed":
            desk.end()
            desk.end()
            desk.opening = 0.0
            opened = desk.end()
        else:
            opened = desk.end(success=False)
        desk.opening = BODY.arm.gripper.max_opening
        assert opened.gripper == desk.opening
        assert desk.end().motion == "line"
        assert desk.end().joint_target == BODY.arm.home[:4]
        assert desk.end() is None
    while desk.look().setpoints is not None:
        assert desk.brain.subtasks() == ["back off"]
    problem = {"missed": "the gripper holds nothing", "refused": "no way"}[goal]
    assert desk.brain.subtasks() == [f"cannot: {problem}"]
    assert desk.brain.plan(0)["problem"] == problem


def test_what_is_not_told_is_named() -> None:
    for names in ((), ENVIRONMENT[:-1]):
        with pytest.raises(ConfigError, match="environment"):
            FetchBrain().bind(RobotFeatures(NAMES, BODY.limits.names, FPS, names, BODY))


def test_the_arm_of_a_base_reaches_in_an_empty_arena_and_its_base_navigates_with_the_arm_at_home() -> None:
    config, specs = TurtleBot3ManipulationConfig(), [EpisodeSpec(0, 3), EpisodeSpec(1, 5)]
    body = config.body()
    reach = EpisodeLoop(Simulation(config, 2), ReachTask(ReachConfig(), 2, config.fps, body), ReachBrain())
    assert [one.outcome.event for one in reach.run(specs, lambda: False)] == [Event.SUCCESS] * 2
    drive = EpisodeLoop(Simulation(config, 2), NavigateTask(NavigateConfig(), 2, config.fps, body), NavigatorBrain())
    for episode in drive.run(specs, lambda: False):
        assert episode.outcome.event == Event.SUCCESS
        np.testing.assert_allclose(
            episode.columns["control.applied_action"][:, :5], np.tile(HOME[:5], (episode.frames, 1)), atol=1e-6
        )
