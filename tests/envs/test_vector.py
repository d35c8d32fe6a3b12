"""Many environments at once: the same as one by one, to the last bit, in every autoreset mode."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from bhd_lerobot.envs.episodes import ClosedError, ResetNeededError
from bhd_lerobot.envs.gym_env import BhdEnv
from bhd_lerobot.envs.sequence import STREAM
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ActionError, ConfigError
from tests.cases import each_case
from tests.envs.support import NAMES, assert_same, short, some_actions

AVOID = "TurtleBot3Avoid-v0"
MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)
N = 3


def makers(name: str, n: int = N, **arguments: Any) -> list[Any]:
    def maker(first: int) -> Any:
        return lambda: BhdEnv(name, **short(name, **arguments), first_episode=first)

    return [maker(first) for first in range(n)]


def make(n: int = N, name: str = AVOID, **arguments: Any) -> BhdVectorEnv:
    return BhdVectorEnv(n, name, **short(name, **arguments))


def play(env: VectorEnv, actions: np.ndarray, **reset: Any) -> Iterator[Any]:
    yield env.reset(**reset)
    for action in actions:
        yield env.step(action)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(
    ("name", "mode"),
    [*((name, AutoresetMode.SAME_STEP) for name in NAMES), *((name, AutoresetMode.NEXT_STEP) for name in NAMES[::3])],
)
def test_it_is_the_single_environments_bit_for_bit(name: str, mode: AutoresetMode) -> None:
    ours = gymnasium.make_vec(f"bhd_lerobot/{name}", N, autoreset_mode=mode, threads=1, **short(name))
    assert isinstance(ours, BhdVectorEnv)  # Gymnasium makes ours by itself
    sync = SyncVectorEnv(makers(name), autoreset_mode=mode)
    actions = some_actions(name, 60, N)
    ends = 0
    for mine, theirs in zip(play(ours, actions), play(sync, actions), strict=True):
        assert_same(mine, theirs)
        ends += int((mine[2] | mine[3]).sum()) if len(mine) == 5 else 0
    assert ends > N  # otherwise nothing that follows an end was compared
    assert ours.observation_space == sync.observation_space
    assert ours.action_space == sync.action_space
    ours.close()
    sync.close()


def test_environments_run_different_episodes_that_follow_from_the_seed() -> None:
    env = make(task={"duration_s": 0.1}, autoreset_mode="SameStep")
    seen = [env.reset(seed=10)[1]["episode_index"].tolist()]
    seen += [env.step(np.zeros((N, 2), np.float32))[4]["episode_index"].tolist() for _ in range(2)]
    assert seen == [[10, 11, 12], [STREAM + 10, STREAM + 11, STREAM + 12], [2 * STREAM + k for k in (10, 11, 12)]]
    assert env.reset(seed=[5, None, 5])[1]["episode_index"].tolist() == [5, 3 * STREAM + 11, 5]
    dense = make(task={"duration_s": 0.1}, autoreset_mode="SameStep", episode_stride=N)
    assert dense.reset()[1]["episode_index"].tolist() == [0, 1, 2]
    assert dense.reset()[1]["episode_index"].tolist() == [3, 4, 5]
    drawn = make(first_episode=None).reset()[1]["episode_index"].tolist()
    assert len(set(drawn)) == N


def test_what_was_handed_out_is_never_written_to_again() -> None:
    env = make(autoreset_mode="SameStep")
    given = [env.reset()[0], *(env.step(action)[0] for action in some_actions(AVOID, 30, N))]
    copies = [one["agent_pos"].copy() for one in given]
    for action in some_actions(AVOID, 30, N):
        env.step(action)
    for one, copy in zip(given, copies, strict=True):
        np.testing.assert_array_equal(one["agent_pos"], copy)


def test_a_mask_resets_some_of_them() -> None:
    env = make(autoreset_mode="Disabled", task={"duration_s": 0.2})
    with pytest.raises(ResetNeededError, match="without a mask"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    env.reset(seed=0)
    for _ in range(2):
        last = env.step(np.zeros((N, 2), np.float32))
    assert last[3].all()
    with pytest.raises(ResetNeededError, match=r"environments \[0, 1, 2\] are over"):
        env.step(np.zeros((N, 2), np.float32))
    _, infos = env.reset(options={"reset_mask": np.array([True, True, False])})
    assert infos["_episode_index"].tolist() == [True, True, False]
    with pytest.raises(ResetNeededError, match=r"environments \[2\] are over"):
        env.step(np.zeros((N, 2), np.float32))
    env.reset(options={"reset_mask": np.array([False, False, True])})
    env.step(np.zeros((N, 2), np.float32))


@pytest.mark.parametrize("mode", MODES)
def test_in_a_rollout_of_lerobot_what_is_over_is_left_alone(mode: AutoresetMode) -> None:
    ours, plain = make(autoreset_mode=mode), make(autoreset_mode="SameStep")
    ours.reset(seed=0, options={"lerobot_new_rollout": True})
    plain.reset(seed=0)
    over, last = np.zeros(N, np.bool_), None
    for action in some_actions(AVOID, 25, N):
        mine, other = ours.step(action), plain.step(action)
        running = ~over
        for index in (1, 2, 3):
            np.testing.assert_array_equal(mine[index][running], other[index][running])
        if last is not None:
            np.testing.assert_array_equal(mine[0]["agent_pos"][over], last[0]["agent_pos"][over])
            assert (mine[1][over] == 0).all()
            assert (mine[2] | mine[3])[over].all()
        over |= mine[2] | mine[3]
        np.testing.assert_array_equal(ours.episodes.running, ~over)
        last = mine
    assert over.all()
    assert ours.reset(seed=7)[1]["episode_index"].tolist() == [7, 8, 9]
    assert ours.episodes.running.all()


def test_attributes_are_found_and_set() -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.call("_max_episode_steps") == (20,) * N
    assert env.get_attr("task") == (AVOID,) * N
    assert env.call("task_description") == ("Roam without touching anything.",) * N
    assert env.get_attr("render_mode") == ("rgb_array",) * N
    images = env.call("render")
    assert len(images) == N
    np.testing.assert_array_equal(np.stack(images[:2])[1], images[1])
    with pytest.raises(AttributeError):
        env.get_attr("colour")
    env.set_attr("split", "held_out")
    assert (env.reset()[1]["seed"] % 2 == 1).all()
    assert env.get_attr("episode_index") == (STREAM, STREAM + 1, STREAM + 2)
    env.set_attr("seed", [1, 2, 3])
    assert env.get_attr("seed") == (1, 2, 3)
    for name, value in (("colour", 1), ("seed", [1, 2]), ("split", "test"), ("seed", -1)):
        with pytest.raises(ConfigError, match=r"colour|2 values for 3|split is|seed is"):
            env.set_attr(name, value)
    env.close()


@each_case(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"num_envs": 2.0}, "num_envs is 2.0"),
        ({"autoreset_mode": "Later"}, "Unknown autoreset_mode 'Later'"),
    ],
)
def test_what_cannot_be_honoured_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        BhdVectorEnv(**{"num_envs": 2, "environment": AVOID, **arguments})
    assert message in str(caught.value)


def test_wrong_actions_and_seeds_are_named() -> None:
    env = make()
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(np.zeros((N, 2), np.float32))
    with pytest.raises(ConfigError, match="2 seeds for 3 environments"):
        env.reset(seed=[1, 2])
    with pytest.raises(ConfigError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(N, np.bool_)})
    env.reset()
    wrong = np.zeros((N, 2), np.float32)
    wrong[1, 1] = np.nan
    with pytest.raises(ActionError, match=r"'theta.vel' of environment 1 is nan"):
        env.step(wrong)
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.call("task"), lambda: env.step(np.zeros((N, 2), np.float32))):
        with pytest.raises(ClosedError, match="was closed"):
            use()
