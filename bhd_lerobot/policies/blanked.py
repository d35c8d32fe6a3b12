"""The brain `blanked`: another brain without its instruction or images, or with those of another episode.

It shows what a brain uses them for. One that refuses an empty instruction or a black image shows that with those of
another episode only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command, CommandResult
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import (
    Brain,
    BrainConfig,
    DriverConfig,
    Observation,
    RobotFeatures,
)


@BrainConfig.register_subclass("blanked")
@dataclass
class BlankedConfig(BrainConfig):
    """Parameters of a brain that lacks a sense.

    Attributes:
        brain: the brain.
        instruction: whether it gets an empty instruction in place of the episode's.
        images: whether all its images are black.
        exchange: whether it gets, instead, the instruction or the images of the episode in the next simulation; needs
            two or more. What it does then depends on which episodes run side by side (`n_envs`).
    """

    is_composed: ClassVar[bool] = True

    brain: DriverConfig
    instruction: bool = False
    images: bool = False
    exchange: bool = False

    def __post_init__(self) -> None:
        if not (self.instruction or self.images):
            raise ConfigError("brain.type is 'blanked' and nothing is: set brain.instruction or brain.images to true.")
        own = getattr(self.brain, "instruction", "")
        if self.instruction and own:
            raise ConfigError(
                f"brain.instruction is true, and brain.brain.instruction is {own!r}, which the "
                "brain would carry out. Leave one of them out."
            )


class BlankedBrain(Brain):
    """Passes everything on to a brain but its instruction or its images."""

    name = "blanked"

    def __init__(self, config: BlankedConfig, brain: Brain) -> None:
        super().__init__(config)
        self._brain = brain
        self.has_plan, self.uses_images, self.attempts = brain.has_plan, brain.uses_images, brain.attempts
        self.uses_privileged_state = brain.uses_privileged_state
        self._instructions: list[str] = []

    def bind(self, robot: RobotFeatures) -> None:
        """Bind the brain."""
        self._brain.bind(robot)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes."""
        if self.config.exchange and n == 1:
            raise ConfigError(
                "brain.exchange is true and there is one simulation: no other episode runs beside it. "
                "Set n_envs to 2 or more, or brain.exchange to false."
            )
        if self.config.instruction:
            instructions = self._other_instructions(ids, n, instructions)
        self._brain.reset(ids, seeds, n, instructions)

    def _other_instructions(self, ids: NDArray[np.intp], n: int, instructions: Sequence[str]) -> list[str]:
        if not self.config.exchange:
            return [""] * len(instructions)
        if len(self._instructions) != n:
            self._instructions = [""] * n
        for sim, instruction in zip(ids, instructions, strict=True):
            self._instructions[sim] = instruction
        return [self._instructions[(sim + 1) % n] for sim in ids]

    def needs_images(self, results: Mapping[int, Sequence[CommandResult]]) -> NDArray[np.bool_]:
        """Return where the brain looks; with exchanged images, in all simulations if it looks at those of any."""
        looks = self._brain.needs_images(results)
        return np.array(looks.any()) if self.config.images and self.config.exchange else looks

    def subtasks(self) -> Sequence[str]:
        """Return what the brain is doing."""
        return self._brain.subtasks()

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the brain's plan."""
        return self._brain.plan(sim)

    def act(self, observation: Observation) -> Command:
        """Return what the brain commands."""
        if self.config.images:
            seen = {
                name: self._other_images(images, observation.running) for name, images in observation.images.items()
            }
            observation = replace(observation, images=seen)
        return self._brain.act(observation)

    def _other_images(self, images: NDArray[np.uint8], running: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
        """Return black images, or those of the next simulation that is in an episode; black where there is none."""
        other = np.zeros_like(images)
        if self.config.exchange:
            sims = np.arange(len(images)) if running is None else np.flatnonzero(running)
            if len(sims) > 1:
                other[sims] = images[np.roll(sims, -1)]
        return other

    def close(self) -> None:
        """Close the brain."""
        self._brain.close()

    def parameters(self) -> dict[str, Any]:
        """Return what is blanked, and the brain's parameters."""
        blanked = {name: getattr(self.config, name) for name in ("instruction", "images", "exchange")}
        return {"type": self.name, **blanked, "brain": self._brain.parameters()}
