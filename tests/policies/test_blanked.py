"""A brain without a sense: what the brain in it gets."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.blanked import BlankedBrain, BlankedConfig
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.policies.language.language_brain import LanguageBrainConfig


class Spy(Brain):
    """Notes what it gets."""

    has_plan, uses_images, uses_privileged_state = True, True, False

    def __init__(self, looks: list[bool] | None = None) -> None:
        super().__init__(None)
        self.where = looks

    def needs_images(self, results: Any) -> np.ndarray:
        return super().needs_images(results) if self.where is None else np.array(self.where)

    def parameters(self) -> dict[str, Any]:
        return {}

    def reset(self, ids: Any, seeds: Any, n: int, instructions: Any = ()) -> None:
        self.instructions = list(instructions)

    def act(self, observation: Observation) -> str:
        self.seen = observation
        return "its command"


@pytest.mark.law
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
    assert brain.needs_images({}).tolist() is True
    spy.where = [True, False]
    assert brain.needs_images({}).tolist() == [True, False]


def test_what_is_exchanged_is_that_of_the_next_simulation_and_nobodys_own() -> None:
    spy: Any = Spy(looks=[False, True, False])
    brain = BlankedBrain(BlankedConfig(brain=None, instruction=True, images=True, exchange=True), spy)  # type: ignore[arg-type]
    brain.reset(np.arange(3), [1, 2, 3], 3, ["a", "b", "c"])
    assert spy.instructions == ["b", "c", "a"]
    brain.reset(np.array([0, 2]), [4, 5], 3, ["d", "e"])
    assert spy.instructions == ["b", "d"]
    # Where it looks in one simulation, the images of the others are needed.
    assert brain.needs_images({}).all()
    spy.where = [False, False, False]
    assert not brain.needs_images({}).any()
    images = np.arange(1, 4, dtype=np.uint8)[:, None, None, None] * np.ones((3, 4, 6, 3), np.uint8)
    state = np.zeros((3, 1))
    # Of those that run each gets another's; one that is alone gets none.
    for running, seen in (([1, 1, 1], [2, 3, 1]), ([1, 0, 1], [3, 0, 1]), ([0, 1, 0], [0, 0, 0])):
        brain.act(Observation(("a",), state, {"scene": images}, running=np.array(running, np.bool_)))
        assert spy.seen.images["scene"][:, 0, 0, 0].tolist() == seen
    assert images[:, 0, 0, 0].tolist() == [1, 2, 3]
    brain.reset(np.arange(4), [1, 2, 3, 4], 4, ["a", "b", "c", "d"])
    assert spy.instructions == ["b", "c", "d", "a"]
    assert brain.parameters()["exchange"]
    with pytest.raises(ConfigError, match=r"there is one simulation.*Set n_envs to 2 or more"):
        brain.reset(np.arange(1), [1], 1, ["a"])


def test_what_cannot_be_blanked_is_refused_and_who_does_not_say_it_is_taken_to_be_told_the_truth() -> None:
    inner: Any = Brain(None)
    assert BlankedBrain(BlankedConfig(brain=None, images=True), inner).uses_privileged_state  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"brain\.brain\.instruction is 'pick up the red cup'"):
        BlankedConfig(LanguageBrainConfig(instruction="pick up the red cup"), instruction=True)
    with pytest.raises(ConfigError, match=r"nothing is: set brain\.instruction or brain\.images"):
        BlankedConfig(brain=None)  # type: ignore[arg-type]
