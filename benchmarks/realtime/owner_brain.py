"""The brain of the benchmark's episodes: it moves the arm gently to and fro, with or without a network on the way."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.robots.ur5_simulation import JOINT_ACTIONS

_AMPLITUDE = np.array([0.25, 0.1, 0.1, 0.2, 0.2, 0.4, 0.01])  # [rad; m for the gripper]
_PERIOD_S = 4.0
_NETWORK_SHARE = 0.001  # [rad] what the network's output adds: it is untrained, and is there to be computed

Network = Callable[[Observation], NDArray[np.float64]]


def make_network(names: Sequence[str], actions: int) -> tuple[Network, int]:
    """Return a network of a real policy's size that looks at state and images, and its number of parameters.

    Args:
        names: the observation's floats.
        actions: values to be put out.
    """
    import torch
    from torch import nn

    torch.manual_seed(0)
    layers: list[nn.Module] = []
    for before, after, stride in ((3, 32, 4), (32, 64, 2), (64, 128, 2), (128, 256, 2)):
        layers += [nn.Conv2d(before, after, 3, stride, 1), nn.ReLU()]
    eyes = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(4), nn.Flatten())
    head = nn.Sequential(nn.Linear(2 * 256 * 16 + len(names), 512), nn.ReLU(), nn.Linear(512, actions), nn.Tanh())
    eyes.eval()
    head.eval()

    def network(observation: Observation) -> NDArray[np.float64]:
        with torch.inference_mode():
            images = np.concatenate(list(observation.images.values()))
            seen = eyes(torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255).reshape(1, -1)
            state = torch.from_numpy(observation.state.astype(np.float32))
            return np.asarray(head(torch.cat([seen, state], dim=1)), np.float64)

    parameters = sum(p.numel() for module in (eyes, head) for p in module.parameters())
    return network, parameters


class SwayBrain:
    """Moves every joint on a sine around where the episode began.

    Args:
        with_network: run a network of torch on every observation first.
    """

    name = "sway"
    robot_type = "ur5"
    has_plan = False

    def __init__(self, *, with_network: bool) -> None:
        self.uses_images = with_network
        self.parameter_count = 0
        self._network: Network | None = None
        self._start: NDArray[np.float64] | None = None
        self._begun = 0.0

    def bind(
        self,
        observation_names: Sequence[str],
        action_names: Sequence[str],
        fps: int,
        environment_names: Sequence[str] = (),
    ) -> None:
        """Make the network."""
        self._columns = [observation_names.index(name) for name in JOINT_ACTIONS]
        if self.uses_images:
            self._network, self.parameter_count = make_network(observation_names, len(action_names))

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start an episode."""
        self._start = None

    def subtasks(self) -> Sequence[str]:
        """There is no plan."""
        return ()

    def plan(self, sim: int) -> dict[str, Any]:
        """There is no plan."""
        return {}

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return joint positions and the gripper's opening, shape (1, 7)."""
        if self._start is None:
            self._start, self._begun = observation.state[:, self._columns].copy(), time.monotonic()
        way = math.sin(2 * math.pi * (time.monotonic() - self._begun) / _PERIOD_S)
        action = self._start + way * _AMPLITUDE
        return action if self._network is None else action + _NETWORK_SHARE * self._network(observation)

    def parameters(self) -> dict[str, Any]:
        """Return what defines the brain."""
        return {"with_network": self.uses_images}
