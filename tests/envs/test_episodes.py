"""An episode stepped from outside is the episode that the loop runs."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.envs.episodes import SteppedEpisodes
from bhd_lerobot.envs.gym_env import BhdEnv
from bhd_lerobot.envs.settings import make_settings
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.registry import make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.task import Event, episode_seed
from tests.cases import each_case
from tests.envs.support import NAMES, short, some_actions

ONE = np.zeros(1, np.intp)


class Script(Brain):
    """Plays rows of actions, the same in every simulation, from each episode's start."""

    name = "script"

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def bind(self, *args: Any) -> None:
        pass

    def reset(self, ids: np.ndarray, seeds: Any, n: int, instructions: Any = ()) -> None:
        if not hasattr(self, "frame"):
            self.frame = np.zeros(n, int)
        self.frame[ids] = 0

    def act(self, observation: Any) -> np.ndarray:
        actions = self.rows[self.frame].astype(np.float64)
        self.frame += 1
        self.frame %= len(self.rows)
        return actions

    def parameters(self) -> dict[str, Any]:
        return {}


@each_case("name", NAMES)
def test_an_episode_is_that_of_the_loop_bit_for_bit(name: str) -> None:
    arguments = short(name)
    settings = make_settings(name, arguments.get("robot"), arguments["task"])
    n = 2
    task = make_task(settings.task, n, settings.robot.fps)
    brain = Script(some_actions(name, 40)[:, 0])
    specs = [EpisodeSpec(k, episode_seed(3, k, "held_out")) for k in range(3)]
    episodes = list(EpisodeLoop(make_simulation(settings.robot, n), task, brain).run(specs))
    env = BhdEnv(name, seed=3, split="held_out", **arguments)
    for episode in episodes:
        columns = episode.columns
        observation, info = env.reset(seed=episode.spec.index)
        assert info["seed"] == episode.spec.seed
        for frame in range(episode.frames):
            np.testing.assert_array_equal(observation["agent_pos"], columns[keys.OBSERVATION_STATE][frame])
            if keys.ENVIRONMENT_STATE in columns:
                np.testing.assert_array_equal(observation["environment_state"], columns[keys.ENVIRONMENT_STATE][frame])
            np.testing.assert_array_equal(env.episodes.simulation.physics_state[0], columns[keys.PHYSICS_STATE][frame])
            observation, reward, terminated, truncated, info = env.step(columns[keys.ACTION][frame])
            assert np.float32(reward) == columns[keys.REWARD][frame]
            assert (terminated or truncated) == bool(columns[keys.DONE][frame])
            assert info["event"] == Event(columns[keys.EVENT][frame]).cause
        assert info["score"] == episode.outcome.score
        assert info["details"] == episode.outcome.details
        assert info["is_success"] == episode.outcome.success
    env.close()


def test_a_success_that_is_an_achievement_terminates() -> None:
    episodes = SteppedEpisodes(make_settings("UR5Reach-v0").robot, make_settings("UR5Reach-v0").task)
    episodes.reset(ONE, [0])
    episodes.task.judge = lambda truth, running: (np.ones(1), np.full(1, int(Event.SUCCESS)))  # type: ignore[method-assign]
    stepped = episodes.step(np.array(episodes.simulation.body.arm.home)[None])
    assert stepped.terminated.all()
    assert not stepped.truncated.any()


@pytest.mark.parametrize(("mode", "event"), [(Mode.FAULT, Event.FAULT), (Mode.ESTOP, Event.ESTOP)])
def test_a_robot_that_has_latched_a_stop_terminates(mode: Mode, event: Event) -> None:
    settings = make_settings("TurtleBot3Avoid-v0", {"beams": 36})
    episodes = SteppedEpisodes(settings.robot, settings.task, 2)
    episodes.reset(np.arange(2), [0, 2])
    if mode == Mode.ESTOP:
        episodes.simulation.bridge.estop(np.array([1]))
    else:
        episodes.simulation.cerebellum.interrupt(Watchdog.PLANT, Mode.FAULT)
    stepped = episodes.step(np.zeros((2, 2)))
    assert stepped.event[1] == event
    assert stepped.terminated[1]
    assert not stepped.truncated[1]
    assert (stepped.event[0] == event) == (mode == Mode.FAULT)
