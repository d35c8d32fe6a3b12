from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

from bhd_lerobot.envs.sequence import STREAM
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.rl.config import RewardConfig, RlConfig, parse_rl
from bhd_lerobot.training.rl.environment import FeatureStack, RlVecEnv, Shaping, pose_potential
from bhd_lerobot.training.rl.learner import make_learner
from bhd_lerobot.training.rl.parts import RlParts, make_parts
from tests.training.rl.test_train import options as run_options

N = 3


def options(duration_s: int = 1) -> list[str]:
    episodes = {"task__duration_s": duration_s, "task__min_path_m": 0, "env__n_envs": N}
    policy = {"policy__n_obs_steps": 3, "policy__hidden_dims": [8], "policy__scan__transform": None}
    return run_options(**episodes, **policy, ppo__n_steps=12, ppo__batch_size=12)


def environment(config: RlConfig) -> BhdVectorEnv:
    return BhdVectorEnv(
        N, config.environment, config.robot, config.task, autoreset_mode="Disabled", threads=1, seed=config.seed
    )


class Rig:
    def __init__(self, duration_s: int = 1, reward: RewardConfig | None = None) -> None:
        self.config = parse_rl(options(duration_s))
        self.env = environment(self.config)
        self.parts: RlParts = make_parts(self.config, self.env)
        self.adapter = RlVecEnv(self.env, self.parts, reward or self.config.reward, self.config.ppo.gamma)
        self.episodes: list[dict] = []

    def step(self, forward: float = 0.0) -> tuple:
        self.adapter.step_async(np.tile(np.float32([forward, 0.0]), (N, 1)))
        result = self.adapter.step_wait()
        self.episodes += [info for info in result[3] if "episode" in info]
        return result


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.adapter.close()


def test_a_vector_is_what_the_policy_sees_of_the_frames_that_its_configuration_names(rig: Rig) -> None:
    rig.env.close()
    env = environment(rig.config)
    seen = [env.reset()[0]["agent_pos"]]
    action = np.tile(np.float32([0.1, 0.0]), (N, 1))
    stack = FeatureStack(rig.parts.front, rig.parts.before, N)
    stack.restart(np.arange(N), {"observation.state": seen[0]})
    for _ in range(5):
        seen.append(env.step(action)[0]["agent_pos"])
        stack.push({"observation.state": seen[-1]})
    env.close()
    batch = {"observation.state": torch.from_numpy(np.stack([seen[1], seen[3], seen[5]], axis=1))}
    wanted = rig.parts.front.features(rig.parts.before(batch)).detach().numpy()
    np.testing.assert_array_equal(stack.features(), wanted)


def test_at_an_episodes_start_nothing_was_before_its_first_frame(rig: Rig) -> None:
    rows = {"observation.state": np.arange(N * 38, dtype=np.float32).reshape(N, 38) + 1}
    rig.adapter.stack.restart(np.arange(N), rows)
    rig.adapter.stack.push({"observation.state": rows["observation.state"] * 2})
    rig.adapter.stack.restart(np.array([1]), rows)
    batch = {"observation.state": torch.from_numpy(np.stack([rows["observation.state"]] * 3, axis=1))}
    wanted = rig.parts.front.features(rig.parts.before(batch)).detach().numpy()
    np.testing.assert_array_equal(rig.adapter.stack.features()[1], wanted[1])
    assert not np.array_equal(rig.adapter.stack.features()[0], wanted[0])


def test_an_episode_whose_time_is_over_is_truncated_and_the_next_begins_in_the_same_step(rig: Rig) -> None:
    rig.adapter.reset()
    episodes = [member.sequence.episode for member in rig.env.members]
    for _ in range(9):
        features, _, done, infos = rig.step()
        assert not done.any()
        assert not any("episode" in info or info["TimeLimit.truncated"] for info in infos)
    before = features
    features, _, done, infos = rig.step()
    assert done.all()
    for sim, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["event"] == "success"
        # It stood still: what it saw last is what it saw before, but for the noise of a scan; the new arena is another.
        assert np.abs(info["terminal_observation"] - before[sim]).max() < np.abs(features[sim] - before[sim]).max()
        assert info["episode"]["l"] == 10
    assert [member.sequence.episode for member in rig.env.members] == [episode + STREAM for episode in episodes]
    assert len(rig.episodes) == N


def collide(rig: Rig) -> tuple:
    rig.adapter.reset()
    rig.env.episodes.simulation.touches[0][0] = False
    for _ in range(400):
        features, reward, done, infos = rig.step(forward=1.0)
        hits = [sim for sim, info in enumerate(infos) if info.get("event") == "collision"]
        if hits:
            return hits[0], features, reward, done, infos
    raise AssertionError("No robot that drives straight on ran into anything.")


def test_a_collision_costs_what_the_configuration_says_and_what_is_reported_is_the_tasks_own_return() -> None:
    reported = []
    for own in (RewardConfig(), RewardConfig(scale=0.5, events={"collision": -7.0, "stuck": -9.0})):
        rig = Rig(60, reward=own)
        sim, _, reward, done, infos = collide(rig)
        rig.adapter.close()
        assert done[sim]
        assert infos[sim]["TimeLimit.truncated"] is False
        assert not own.events or reward[sim] == pytest.approx(-7.0)
        reported.append([{key: episode[key] for key in ("episode", "score", "event")} for episode in rig.episodes])
    assert reported[0] == reported[1]
    assert reported[0][0]["episode"]["r"] >= 0


@pytest.mark.parametrize(("truncated", "factor"), [(True, 1.0), (False, 0.0)])
def test_the_learner_adds_the_value_of_what_would_have_come_to_truncated_episodes_only(
    rig: Rig, truncated: bool, factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = make_learner(rig.config, rig.parts, rig.adapter)
    with torch.no_grad():
        learner.policy.value_net.weight.zero_()
        learner.policy.value_net.bias.fill_(5.0)
    if not truncated:
        step = rig.env.step

        def ended(actions: np.ndarray) -> tuple:
            observation, reward, terminated, over, info = step(actions)
            return observation, reward, terminated | over, np.zeros_like(over), info

        monkeypatch.setattr(rig.env, "step", ended)
    _, callback = learner._setup_learn(1000)
    learner.collect_rollouts(rig.adapter, callback, learner.rollout_buffer, 12)
    rewards = learner.rollout_buffer.rewards
    # Frame 9 ends the episodes of one second.
    np.testing.assert_allclose(rewards[9] - rewards[8], rig.config.ppo.gamma * 5.0 * factor, atol=0.2)
    assert learner.rollout_buffer.episode_starts[10].all()


@pytest.mark.law
def test_shaping_leaves_the_tasks_reward_alone_and_a_potential_cancels_out_over_an_episode() -> None:
    shaping = Shaping(RewardConfig(potential="pose"), 1.0, 2)
    potentials = np.array([[-3.0, -1.0], [-2.0, -4.0], [-0.5, -2.5]])
    shaping.restart(np.arange(2), potentials[0])
    reward, nothing, going_on = np.array([0.25, 0.5]), np.zeros(2, np.int64), np.zeros(2, np.bool_)
    total = np.zeros(2)
    for potential in potentials[1:]:
        total += shaping(reward, nothing, going_on, potential)
    np.testing.assert_allclose(total, 2 * reward + potentials[-1] - potentials[0])
    np.testing.assert_array_equal(reward, [0.25, 0.5])
    # A state after which nothing comes has the potential 0.
    last = shaping(reward, np.array([Event.COLLISION, 0]), np.array([True, False]), potentials[0])
    np.testing.assert_allclose(last, [0.25 + 0.5, 0.5 + 1.5])


def test_the_potential_is_zero_at_the_target_and_falls_with_distance_and_angle() -> None:
    target = np.array([[0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0]])
    assert pose_potential(target, -target * [[-1, -1, -1, 1, 1, 1, 1]], 2.0, 0.5) == pytest.approx(0.0, abs=1e-6)
    moved, turned = target.copy(), target.copy()
    moved[0, 0] += 0.1
    turned[0, 3:] = np.cos(0.2), np.sin(0.2), 0.0, 0.0
    assert pose_potential(moved, target, 2.0, 0.5) == pytest.approx(-0.2)
    assert pose_potential(turned, target, 2.0, 0.5) == pytest.approx(-0.2)


def test_the_critic_sees_more_than_the_actor_and_the_actor_what_it_saw_before() -> None:
    config = parse_rl([*options(1), "--robot.lidar_noise_std=0", "--robot.collision_monitor=true"])
    env = environment(config)
    parts = make_parts(config, env)
    adapter = RlVecEnv(env, parts, config.reward, 0.99, privileged=True)
    seen, size = adapter.reset(), adapter.stack.size
    np.testing.assert_array_equal(seen[:, :size], adapter.stack.features())
    assert size == parts.actor.feature_size
    # The scan was taken where the robots stand: of 36 beams each is one of the directions.
    simulation: Any = env.episodes.simulation
    near = simulation.body.drive.radius / simulation.lidar.ranges
    np.testing.assert_allclose(seen[:, size : size + 36], np.minimum(near, 1.0), atol=0.02)
    learner = make_learner(config, parts, adapter)
    other = seen.copy()
    other[:, size:] += 0.5
    for name, is_same in (("forward_actor", True), ("forward_critic", False)):
        both = [getattr(learner.policy.mlp_extractor, name)(torch.from_numpy(rows)) for rows in (seen, other)]
        assert torch.equal(*both) is is_same
    adapter.close()


def test_the_critic_is_told_when_the_monitor_keeps_the_robot_from_an_obstacle() -> None:
    config = parse_rl([*options(60), "--robot.collision_monitor=true"])
    env = environment(config)
    adapter = RlVecEnv(env, make_parts(config, env), config.reward, 0.99, privileged=True)
    adapter.reset()
    flags = []
    for _ in range(150):  # they drive straight on until they stand before something
        adapter.step_async(np.tile(np.float32([1.0, 0.0]), (N, 1)))
        flags.append(adapter.step_wait()[0][:, -1])
    adapter.close()
    assert not flags[0].any()
    assert np.any(flags, axis=0).all()


def test_the_adapter_refuses_an_environment_that_begins_anew_by_itself(rig: Rig) -> None:
    env = BhdVectorEnv(1, rig.config.environment, rig.config.robot, autoreset_mode="SameStep", threads=1)
    with pytest.raises(ConfigError, match="Disabled"):
        RlVecEnv(env, rig.parts, rig.config.reward, 0.99)
    env.close()
