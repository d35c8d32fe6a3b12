"""What happens before and after `bhd_pixels`: instructions become bytes; state and actions are normalised."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_LANGUAGE_TOKENS
from torch import Tensor

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig
from bhd_lerobot.policies.trained_steps import Pipelines, Stats, TrainedStep, make_pipelines


@ProcessorStepRegistry.register(name="bhd_instruction_processor")
@dataclass
class InstructionProcessorStep(TrainedStep):
    """Writes instructions as bytes: every language, no vocabulary, nothing to download."""

    length: int = 128  # bytes, in UTF-8

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with the instructions, in small letters: 1 + each byte, then zeros; (b, length)."""
        task = (self.transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}).get("task")
        if task is None:
            raise ConfigError("bhd_pixels acts on an instruction, and the batch has none (`task`).")
        texts = [task] if isinstance(task, str) else list(task)
        tokens = torch.stack([_tokens(text, self.length) for text in texts])
        return {**observation, OBS_LANGUAGE_TOKENS: tokens}


@lru_cache(maxsize=4096)
def _tokens(text: str, length: int) -> Tensor:
    try:
        encoded = text.strip().lower().encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"The instruction {text!r} is no text that UTF-8 can write: {error.reason}.") from None
    if len(encoded) > length:
        raise ConfigError(
            f"The instruction {text!r} takes {len(encoded)} bytes; this bhd_pixels reads {length}. Shorten it, or "
            "train one with a larger policy.longest_instruction."
        )
    return torch.tensor([byte + 1 for byte in encoded] + [0] * (length - len(encoded)))


def make_bhd_pixels_pre_post_processors(config: PixelsConfig, dataset_stats: Stats | None = None) -> Pipelines:
    """Return LeRobot's pipelines, with the step that writes instructions as bytes."""
    return make_pipelines(config, dataset_stats, first=[InstructionProcessorStep(config.longest_instruction)])
