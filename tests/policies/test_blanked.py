"""A brain without a sense: what the brain in it gets."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.blanked import BlankedBrain, BlankedConfig
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig


class Spy(SimpleNamespace):
    """Notes what it gets."""

    has_plan, uses_images, uses_privileged_state = True, True, False

    def reset(self, ids: Any, seeds: Any, n: int, instructions: Any = ()) -> None:
        self.instructions = list(instructions)

    def act(self, observation: Observation) -> str:
        self.seen = observation
        return "its command"


@pytest.mark.parametrize(("deaf", "blind"), [(True, False), (False, True), (True, True)])
def test_what_is_blanked_does_not_arrive_and_all_else_does(deaf: bool, blind: bool) -> None:
    spy: Any = Spy()
    brain = BlankedBrain(BlankedConfig(brain=None, instruction=deaf, images=blind), spy)  # type: ignore[arg-type]
    images = {"scene": np.full((2, 4, 6, 3), 200, np.uint8), "wrist": np.full((2, 4, 6, 3), 90, np.uint8)}
    state = np.arange(6.0).reshape(2, 3)
    brain.reset(np.arange(2), [1, 2], 2, ["take the cup", "take the box"])
    assert brain.act(Observation(("a", "b", "c"), state, images)) == "its command"
    assert spy.instructions == (["", ""] if deaf else ["take the cup", "take the box"])
    assert spy.seen.images.keys() == images.keys()
    for name, image in images.items():
        assert spy.seen.images[name].shape == image.shape
        assert spy.seen.images[name].max() == (0 if blind else image.max())
    assert spy.seen.state is state
    assert (brain.has_plan, brain.uses_images, brain.uses_privileged_state) == (True, True, False)
    assert images["scene"].min() == 200, "nobody else's images are changed"


def test_of_a_brain_that_does_not_say_it_is_taken_for_granted_that_it_is_told_the_truth() -> None:
    inner: Any = SimpleNamespace(has_plan=False)
    brain = BlankedBrain(BlankedConfig(brain=None, images=True), inner)  # type: ignore[arg-type]
    assert brain.uses_privileged_state


def test_a_brain_that_brings_its_own_instruction_cannot_be_deaf() -> None:
    with pytest.raises(ConfigError, match=r"brain\.brain\.instruction is 'pick up the red cup'"):
        BlankedConfig(LanguageBrainConfig(instruction="pick up the red cup"), instruction=True)


def test_a_brain_that_lacks_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"nothing is: set brain\.instruction or brain\.images"):
        BlankedConfig(brain=None)  # type: ignore[arg-type]
