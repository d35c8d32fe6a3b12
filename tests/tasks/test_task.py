import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import SPLITS, Event, episode_seed


def test_training_and_held_out_seeds_never_meet() -> None:
    rng = np.random.default_rng(0)
    pairs = [(int(a), int(b)) for a, b in rng.integers(0, 2**31, (4000, 2))]
    pairs += [(seed, episode) for seed in range(60) for episode in range(100)]
    train = [episode_seed(seed, episode, "train") for seed, episode in pairs]
    held_out = [episode_seed(seed, episode, "held_out") for seed, episode in pairs]
    assert len(pairs) == 10_000
    assert {seed % 2 for seed in train} == {0}
    assert {seed % 2 for seed in held_out} == {1}
    assert min(train + held_out) >= 0
    assert max(train + held_out) < 2**63
    assert len(set(train)) == len(set(held_out)) == len(pairs)


def test_seeds_fit_the_columns_of_a_dataset_and_do_not_change() -> None:
    """A dataset names its seeds, and a resumed run continues with them: a change breaks both."""
    assert [episode_seed(1, episode, "train") for episode in range(2)] == [3717377837946358014, 38901565946305238]
    assert np.int64(episode_seed(2**62, 2**31, "held_out")) > 0
    assert episode_seed(0, 0, "held_out") == episode_seed(0, 0, "train") + 1


def test_episodes_to_choose_by_are_none_of_those_that_are_learned_from_or_reported() -> None:
    sets = {split: {episode_seed(seed, i, split) for seed in range(20) for i in range(200)} for split in SPLITS}
    assert all(len(one) == 4000 for one in sets.values())
    assert not sets["validation"] & (sets["train"] | sets["held_out"])
    assert all(seed % 2 == 0 for seed in sets["train"])
    assert all(seed % 2 for seed in sets["validation"] | sets["held_out"])


@pytest.mark.parametrize(("seed", "episode"), [(-1, 0), (0, -1)])
def test_negative_numbers_are_refused(seed: int, episode: int) -> None:
    with pytest.raises(ConfigError, match="-1"):
        episode_seed(seed, episode, "train")


def test_an_unknown_split_is_an_error_that_lists_the_valid_ones() -> None:
    with pytest.raises(ConfigError, match="train, held_out"):
        episode_seed(0, 0, "test")  # type: ignore[arg-type]
    assert SPLITS == ("train", "held_out", "validation")


def test_numbers_that_are_recorded_stay_what_they_are() -> None:
    assert [event.cause for event in Event] == [
        "nothing", "success", "collision", "stuck", "timeout", "intervention", "estop", "wrong_object",
        "dropped", "unreachable", "fault", "failure",
    ]  # fmt: skip
    assert [int(event) for event in Event] == list(range(12))
