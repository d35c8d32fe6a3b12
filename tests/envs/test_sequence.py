"""Which episodes an environment runs, one after the other."""

import itertools

import pytest

from bhd_lerobot.envs.sequence import STREAM, EpisodeSequence
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import episode_seed


def played(sequence: EpisodeSequence, seed: int | None, resets: int = 20) -> set[int]:
    """Return the seeds of the episodes of some resets, of which only the first gets a number, as clients do."""
    return {sequence.advance(seed), *(sequence.advance() for _ in range(resets - 1))}


@pytest.mark.law
def test_no_two_seeds_lead_into_the_same_episodes() -> None:
    runs = {seed: played(EpisodeSequence(), seed) for seed in (0, 1, 2, 3, 4, 1000, STREAM - 1)}
    for one, other in itertools.combinations(runs, 2):
        assert not runs[one] & runs[other], (one, other)
    assert runs[3] == played(EpisodeSequence(), 3)


@pytest.mark.parametrize("episode", [-1, 2**63])
def test_numbers_out_of_range_are_refused_and_change_nothing(episode: int) -> None:
    sequence = EpisodeSequence(first=5)
    with pytest.raises(ConfigError, match=f"is {episode}; it must be from 0"):
        sequence.advance(episode)
    assert sequence.advance() == episode_seed(0, 5, "train")
