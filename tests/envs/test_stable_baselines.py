"""The vector environment of stable-baselines3: the same as its own around single environments."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.envs.gym_env import BhdEnv
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.envs.vector_member import Member
from bhd_lerobot.errors import ConfigError

vec_env: Any = pytest.importorskip("stable_baselines3.common.vec_env")

N = 3
OPTIONS: dict[str, Any] = {"robot": {"beams": 36}, "task": {"duration_s": 1.0}, "normalise_actions": True}


def test_it_is_what_stable_baselines3_makes_of_single_environments() -> None:
    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    ours = BhdSb3VecEnv(BhdVectorEnv(N, "TurtleBot3Avoid-v0", autoreset_mode="Disabled", **OPTIONS))
    theirs = vec_env.DummyVecEnv([lambda: BhdEnv("TurtleBot3Avoid-v0", **OPTIONS) for _ in range(N)])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["render_fps"] == theirs.metadata["render_fps"]
    rng, ends = np.random.default_rng(0), 0
    for env in (ours, theirs):
        env.seed(5)
    first, second = ours.reset(), theirs.reset()
    assert ours.reset_infos == theirs.reset_infos
    for _ in range(25):
        for key, value in second.items():
            np.testing.assert_array_equal(first[key], value)
        actions = rng.uniform(-1, 1, (N, 2)).astype(np.float32)
        before = {key: value.copy() for key, value in first.items()}
        kept = first
        (first, *one), (second, *other) = ours.step(actions), theirs.step(actions)
        for key, value in before.items():
            np.testing.assert_array_equal(kept[key], value)  # what was handed out stays as it was
        for mine, its in zip(one[:2], other[:2], strict=True):
            np.testing.assert_array_equal(mine, its)
        assert ours.reset_infos == theirs.reset_infos
        assert len({id(info) for info in one[2]}) == N
        for mine, its in zip(one[2], other[2], strict=True):
            own = ("terminal_observation", "episode")
            assert {k: v for k, v in mine.items() if k not in own} == {k: v for k, v in its.items() if k not in own}
            if "terminal_observation" in its:
                ends += 1
                for key, value in its["terminal_observation"].items():
                    np.testing.assert_array_equal(mine["terminal_observation"][key], value)
    assert ends >= 2 * N
    for env in (ours, theirs):
        env.close()


def test_another_autoreset_mode_is_refused() -> None:
    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    env = BhdVectorEnv(1, "TurtleBot3Avoid-v0", autoreset_mode="SameStep", **OPTIONS)
    with pytest.raises(ConfigError, match=r"autoreset_mode is 'SameStep'.*autoreset_mode='Disabled'"):
        BhdSb3VecEnv(env)
    env.close()


@pytest.fixture
def four() -> Iterator[Any]:
    from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv

    env = BhdVectorEnv(4, "TurtleBot3Avoid-v0", render_mode="rgb_array", autoreset_mode="Disabled", **OPTIONS)
    with closing(BhdSb3VecEnv(env)) as env:
        yield env


@pytest.mark.parametrize(
    ("indices", "changed"), [([2], [2]), (1, [1]), ([0, 3], [0, 3]), (None, [0, 1, 2, 3]), ([], [])]
)
def test_an_attribute_is_set_where_the_indices_say(four: Any, indices: Any, changed: list[int]) -> None:
    four.set_attr("split", "held_out", indices=indices)
    assert four.get_attr("split") == ["held_out" if sim in changed else "train" for sim in range(4)]
    assert four.get_attr("split", indices=indices) == ["held_out"] * len(changed)
    with pytest.raises(ConfigError, match="seed"):
        four.set_attr("sead", 3, indices=indices or 0)


def test_a_method_is_called_where_the_indices_say_and_nowhere_else(four: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    four.reset()
    called: list[Any] = []
    monkeypatch.setattr(Member, "render", lambda self: called.append(self) or len(called))
    assert four.env_method("render", indices=[3, 1]) == [1, 2]
    assert called == [four.env.members[3], four.env.members[1]]
    with pytest.raises(ConfigError, match="without indices"):
        four.set_attr("render_mode", None, indices=[0])


def test_it_is_rendered_from_any_thread(four: Any) -> None:
    four.reset()
    assert four.render_mode == "rgb_array"
    here = four.render()
    with ThreadPoolExecutor(2) as threads:
        for image in threads.map(lambda _: four.render(), range(4)):
            np.testing.assert_array_equal(image, here)
    np.testing.assert_array_equal(four.render(), here)
    assert len(four.get_images()) == 4
