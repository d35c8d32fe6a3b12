"""What others wrote for Gymnasium works on ours: vector wrappers, and every documented way to make an environment."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector

from bhd_lerobot.envs.register import ENVIRONMENTS

AVOID = "bhd_lerobot/TurtleBot3Avoid-v0"
FRAMES = 5
BRIEF: dict[str, Any] = {"robot": {"beams": 8}, "task": {"duration_s": FRAMES / 10}}


VECTOR: dict[str, Callable[[Any], Any]] = {
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "DictInfoToList": vector.DictInfoToList,
    "NormalizeObservation": lambda env: vector.NormalizeObservation(vector.FlattenObservation(env)),
    "FlattenObservation": vector.FlattenObservation,
    "FilterObservation": lambda env: vector.FilterObservation(env, ["agent_pos"]),
    "RescaleAction": lambda env: vector.RescaleAction(env, np.float32(-1), np.float32(1)),
    "NormalizeReward": vector.NormalizeReward,
    "everything": lambda env: vector.DictInfoToList(vector.RecordEpisodeStatistics(env)),
}
N = 3


# Gymnasium's wrappers of observations refuse this mode, with any environment.
NEXT_STEP_ONLY = ("NormalizeObservation", "FlattenObservation", "FilterObservation")


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_wrappers_of_vector_environments(mode: AutoresetMode) -> None:
    for name, wrap in VECTOR.items():
        if mode == AutoresetMode.SAME_STEP and name in NEXT_STEP_ONLY:
            continue
        env = wrap(gymnasium.make_vec(AVOID, N, "vector_entry_point", autoreset_mode=mode, **BRIEF))
        env.action_space.seed(0)
        env.reset(seed=0)
        ended: list[int] = []
        for _ in range(3 * FRAMES):
            _, _, terminated, truncated, infos = env.step(env.action_space.sample())
            done = np.flatnonzero(np.asarray(terminated) | np.asarray(truncated))
            if name == "everything":
                assert all({"episode_index", "seed", "event"} <= info.keys() for info in infos)
                assert all(infos[i]["episode"]["l"] == FRAMES for i in done)
            ended += done.tolist()
        assert len(ended) >= 2 * N, name
        env.close()


FORGET = """
env.reset(seed=0)
env.close()
del sys.modules["bhd_lerobot.envs.register"]
for name in [name for name in gymnasium.registry if name.startswith("bhd_lerobot/")]:
    del gymnasium.registry[name]
"""


@pytest.mark.thorough
def test_every_documented_way_registers_and_makes_an_environment_where_nothing_was_imported() -> None:
    """In one interpreter that forgets the registration after each, because starting one takes seconds."""
    name = f"bhd_lerobot/{next(iter(ENVIRONMENTS))}"
    ways = [
        f"env = gymnasium.make('bhd_lerobot.envs.register:{name}')",
        f"import bhd_lerobot.envs.register; env = gymnasium.make('{name}')",
        f"env = gymnasium.make_vec('bhd_lerobot.envs.register:{name}', 2)",
    ]
    text = "import gymnasium, sys\n" + FORGET.join([*ways, ""])
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
