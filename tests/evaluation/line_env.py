"""A Gymnasium environment of a plug-in: a point on a line, that is to leave [-1, 1] on the right."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from numpy.typing import NDArray


class LineEnv(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    observation_space = gymnasium.spaces.Dict({"agent_pos": gymnasium.spaces.Box(-2, 2, (2,))})
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    task = task_description = "go right"

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict]:
        super().reset(seed=seed)
        self.at, self.speed = self.np_random.uniform(-0.9, 0.9), 0.0
        return self._seen(), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict]:
        self.speed = 0.1 * float(np.tanh(action[0])) + self.np_random.normal(0, 0.05)
        self.at += self.speed
        return self._seen(), self.speed, abs(self.at) > 1, False, {"is_success": self.at > 1}

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((32, 32, 3), np.uint8)

    def _seen(self) -> dict[str, Any]:
        return {"agent_pos": np.array([self.at, self.speed], np.float32)}


gymnasium.register("line/Line-v0", LineEnv, max_episode_steps=30)


@EnvConfig.register_subclass("line")
@dataclass
class LineConfig(EnvConfig):
    task: str | None = "Line-v0"
    fps: int = 5
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(FeatureType.ACTION, (1,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
        }
    )
    features_map: dict[str, str] = field(default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE})

    @property
    def package_name(self) -> str:
        return "line"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"render_mode": "rgb_array"}
