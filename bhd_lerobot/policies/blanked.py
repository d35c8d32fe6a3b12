"""The brain `blanked`: another brain that is deaf or blind, to see what it uses its instruction and its cameras for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import (
    ANY_ROBOT,
    Brain,
    BrainConfig,
    DriverConfig,
    Observation,
    RobotFeatures,
    uses_privileged_state,
)


@BrainConfig.register_subclass("blanked")
@dataclass
class BlankedConfig(BrainConfig):
    """Parameters of a brain that lacks a sense.

    Attributes:
        brain: the brain.
        instruction: whether it gets an empty instruction in place of the episode's.
        images: whether all its images are black.
    """

    is_composed: ClassVar[bool] = True

    brain: DriverConfig
    instruction: bool = False
    images: bool = False

    def __post_init__(self) -> None:
        if not (self.instruction or self.images):
            raise ConfigError("brain.type is 'blanked' and nothing is: set brain.instruction or brain.images to true.")
        own = getattr(self.brain, "instruction", "")
        if self.instruction and own:
            raise ConfigError(
                f"brain.instruction is true, and brain.brain.instruction is {own!r}, which the "
                "brain would carry out. Leave one of them out."
            )


class BlankedBrain:
    """Passes everything on to a brain but its instruction or its images.

    Args:
        config: what is blanked.
        brain: what `config.brain` describes.
    """

    name = "blanked"
    robot_kind = ANY_ROBOT

    def __init__(self, config: BlankedConfig, brain: Brain) -> None:
        self.config, self._brain = config, brain
        self.has_plan = brain.has_plan
        if hasattr(brain, "looks"):
            self.looks = brain.looks

    @property
    def uses_images(self) -> bool:
        """Whether the brain uses images."""
        return self._brain.uses_images

    @property
    def uses_privileged_state(self) -> bool:
        """Whether the brain uses what no sensor tells."""
        return uses_privileged_state(self._brain)

    def bind(self, robot: RobotFeatures) -> None:
        """Bind the brain."""
        self._brain.bind(robot)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes."""
        self._brain.reset(ids, seeds, n, [""] * len(instructions) if self.config.instruction else instructions)

    def subtasks(self) -> Sequence[str]:
        """Return what the brain is doing."""
        return self._brain.subtasks()

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the brain's plan."""
        return self._brain.plan(sim)

    def act(self, observation: Observation) -> Command:
        """Return what the brain commands."""
        if self.config.images:
            black = {name: np.zeros_like(images) for name, images in observation.images.items()}
            observation = replace(observation, images=black)
        return self._brain.act(observation)

    def parameters(self) -> dict[str, Any]:
        """Return what is blanked, and the brain's parameters."""
        blanked = {"instruction": self.config.instruction, "images": self.config.images}
        return {"type": self.name, **blanked, "brain": self._brain.parameters()}
