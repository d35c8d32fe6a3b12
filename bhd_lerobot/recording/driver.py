"""What drives a recording: a brain, a person, or a brain from which a person takes over."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.policies.teleop.takeover import TakeoverBrain
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_brain
from bhd_lerobot.rollout.marks import KEYS, TELEOP_KEYS, MarkKey, Marks
from bhd_lerobot.teleoperators.config_keyboard import KeyboardConfig


@contextmanager
def open_driver(config: RecordConfig, marks: Marks) -> Iterator[Any]:
    """Make what drives; at the end it is closed.

    Args:
        config: of the recording.
        marks: where a person says that they have taken over.
    """
    if config.brain is None:
        raise AssertionError("The configuration has settled what drives the robot.")
    brain: Any = make_brain(config.brain)
    if config.teleop is not None:
        person = TeleopBrain(TeleopConfig(config.teleop, config.map, config.processor))
        brain = TakeoverBrain(brain, person, marks.is_driving)
    try:
        yield brain
    finally:
        brain.close()


def mark_keys(config: RecordConfig) -> Sequence[MarkKey]:
    """Return the keys that mark episodes: not letters while a person drives by those."""
    person = config.brain.teleop if isinstance(config.brain, TeleopConfig) else config.teleop
    return TELEOP_KEYS if isinstance(person, KeyboardConfig) else KEYS
