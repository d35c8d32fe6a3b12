"""Which episodes and frames of a dataset are learned from, and which are held out."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.features import EVENT
from bhd_lerobot.datasets.format.state import DatasetState
from bhd_lerobot.datasets.loader.table import FrameTable, checked_episodes
from bhd_lerobot.errors import ConfigError, DatasetError, unknown_name
from bhd_lerobot.options.declared import Options, Share
from bhd_lerobot.tasks.task import OUTCOMES, Event

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata

HOLD_OUTS = ("episode", "instruction")
"""Of what a share is held out: of all episodes, or of those of each instruction, as LeRobot does it."""


class _Columns(dict[str, list[Any]]):
    @property
    def column_names(self) -> list[str]:
        return list(self)


@dataclass(frozen=True)
class StoredEpisodes:
    """What an `EpisodeFilter` asks a dataset for, of one that was read without LeRobot.

    Attributes:
        episodes: columns of ``meta/episodes`` by name, one entry for each episode.
    """

    root: Path
    total_episodes: int
    total_frames: int
    episodes: _Columns

    @classmethod
    def of(cls, state: DatasetState) -> Self:
        """Return those of a dataset."""
        names = {name for row in state.rows for name in row}
        columns = _Columns({name: [row.get(name) for row in state.rows] for name in sorted(names)})
        return cls(state.root, state.num_episodes, state.num_frames, columns)


@dataclass(frozen=True)
class EpisodeFilter(Options):
    """Which episodes are wanted, by what `bhd-record` stored about each.

    Attributes:
        outcome: `all`, or one or more of the events that an episode can end with.
        min_score: the least score, 0 to 1; any if None.
        exclude_late: leave out episodes with more late frames than their recording tolerated.
    """

    outcome: str | Sequence[str] = "success"
    min_score: Share | None = None
    exclude_late: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [self.outcome] if isinstance(self.outcome, str) else list(self.outcome)
        if not names:
            raise ConfigError(f"No outcome is given. Valid: all, {', '.join(OUTCOMES)}.")
        for name in names:
            if name not in ("all", *OUTCOMES):
                raise ConfigError(unknown_name("outcome", name, ["all", *OUTCOMES]))

    @property
    def outcomes(self) -> tuple[str, ...] | None:
        """The wanted outcomes; None if all are."""
        names = (self.outcome,) if isinstance(self.outcome, str) else tuple(self.outcome)
        return None if "all" in names else names

    def select(
        self, meta: "LeRobotDatasetMetadata | StoredEpisodes", episodes: Sequence[int] | None = None
    ) -> list[int]:
        """Return the wanted ones among some episodes, or among all, ascending."""
        candidates = checked_episodes(meta, episodes)
        wanted = candidates
        if self.outcomes is not None:
            values = _metadata(meta, "outcome", "the outcome 'all'")
            wanted = [episode for episode in wanted if str(values[episode]) in self.outcomes]
        if self.min_score is not None:
            scores = _metadata(meta, "score", "no min_score")
            wanted = [episode for episode in wanted if _score(meta.root, episode, scores[episode]) >= self.min_score]
        if self.exclude_late:
            timings = _metadata(meta, "timing", "exclude_late off")
            wanted = [episode for episode in wanted if not _is_late(meta.root, episode, timings[episode])]
        if not wanted:
            raise DatasetError(self._nothing_left(meta, candidates))
        return wanted

    def _nothing_left(self, meta: "LeRobotDatasetMetadata | StoredEpisodes", candidates: Sequence[int]) -> str:
        criteria = [f"outcome {' or '.join(self.outcomes)}"] if self.outcomes else []
        criteria += [f"a score of at least {self.min_score:g}"] if self.min_score is not None else []
        criteria += ["not too many late frames"] if self.exclude_late else []
        found = ""
        if f"{PREFIX}outcome" in meta.episodes.column_names:
            outcomes = meta.episodes[f"{PREFIX}outcome"]
            counts = Counter(str(outcomes[episode]) for episode in candidates)
            found = f": {', '.join(f'{count} {name}' for name, count in counts.most_common())}"
        return (
            f"No episode of {meta.root} is left after filtering by {' and '.join(criteria)}; it has "
            f"{len(candidates)} episodes{found}. Relax the filter, or record more."
        )


def split_episodes(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int] | None, eval_split: float, hold_out: str = "episode"
) -> tuple[list[int], list[int]]:
    """Return the episodes to train on and those that are held out; always the same for the same dataset.

    Of each instruction the last episodes are held out. How many is counted over all episodes, the instructions one
    after the other: ceil(n * eval_split) in all. Where most instructions occur once, that is one episode in so many.
    With a single instruction it is what LeRobot's `make_train_eval_datasets` does.

    Args:
        eval_split: share that is held out, from 0 to below 1.
        hold_out: `episode` for this rule. `instruction` for LeRobot's, which counts each instruction by itself and
            holds out at least one episode of every one.
    """
    candidates = checked_episodes(meta, None) if episodes is None else [int(episode) for episode in episodes]
    if eval_split == 0:
        return candidates, []
    tasks = meta.episodes["tasks"]
    by_task: dict[str, list[int]] = {}
    for episode in candidates:
        by_task.setdefault(tasks[episode][0] if tasks[episode] else "", []).append(episode)
    train: list[int] = []
    held_out: list[int] = []
    left = len(candidates)
    for group in by_task.values():
        if hold_out == "instruction":
            count = math.ceil(len(group) * eval_split)
        else:
            count = math.ceil(left * eval_split) - math.ceil((left - len(group)) * eval_split)
        left -= len(group)
        train += group[: len(group) - count]
        held_out += group[len(group) - count :]
    if not train:
        raise DatasetError(_nothing_to_train_on(len(candidates), len(by_task), eval_split, hold_out))
    return train, held_out


def _nothing_to_train_on(episodes: int, instructions: int, eval_split: float, hold_out: str) -> str:
    if hold_out == "instruction" and episodes > 1:
        return (
            f"eval_split={eval_split} leaves no episode to train on: {episodes} episodes have {instructions} different "
            "instructions, and with hold_out 'instruction' at least one episode of each is held out. Set hold_out to "
            "'episode', or eval_split to 0."
        )
    return (
        f"eval_split={eval_split} leaves no episode to train on: there are {episodes}, and at least one is held out. "
        "Record more, or set eval_split to 0."
    )


def frame_weights(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int] | None, *, intervention: float = 1.0, learner: float = 1.0
) -> Tensor | None:
    """Return how often each sample is to be drawn, by who drove in its frame.

    Args:
        intervention: of frames in which someone intervened; 0 drops them.
        learner: of the other frames of episodes in which someone could intervene; 0 drops them. All others have 1.

    Returns:
        Shape (N,), float32, in the order of the samples; None if all are drawn equally often.
    """
    if intervention == learner == 1:
        return None
    if EVENT not in meta.features:
        raise DatasetError(
            f"{meta.root} has no column {EVENT!r}, so interventions are unknown. Leave the weights of interventions "
            f"and of learners at 1. It has: {', '.join(meta.features)}."
        )
    table = FrameTable.open(meta, episodes, [EVENT])
    weights = torch.ones(len(table))
    driven = table.columns[EVENT] == int(Event.INTERVENTION)
    name = f"{PREFIX}interventions"
    stored = meta.episodes[name] if name in meta.episodes.column_names else []
    for episode in table.episodes if stored else ():
        if not stored[episode]:
            continue  # nobody could intervene; where nobody did, there is an empty list
        rows = table.rows(episode)
        weights[rows] = learner
        for first, end, _ in json.loads(stored[episode]):  # also the last frame, whose event is what ended the episode
            driven[rows][first:end] = True
    weights[driven] = intervention
    return None if bool((weights == 1).all()) else weights


def _metadata(meta: "LeRobotDatasetMetadata | StoredEpisodes", name: str, remedy: str) -> list[Any]:
    if f"{PREFIX}{name}" not in meta.episodes.column_names:
        raise DatasetError(
            f"{meta.root} has no {PREFIX}{name} for its episodes, because another program recorded it. Filter with "
            f"{remedy}, or give the episodes' numbers."
        )
    return list(meta.episodes[f"{PREFIX}{name}"])


def _score(root: Path, episode: int, stored: object) -> float:
    if not isinstance(stored, int | float | None):
        raise DatasetError(
            f"{PREFIX}score of episode {episode} of {root} is {stored!r:.80} and no number. Filter with no min_score, "
            "or give the episodes' numbers."
        )
    return stored or 0.0


def _is_late(root: Path, episode: int, stored: str | None) -> bool:
    try:
        timing = json.loads(stored or "{}")
        share = (timing.get("tolerated") or {}).get("late_frames", 0.0)
        # The same rule as at the recording; the small number is for products such as 0.07 * 100.
        return bool(timing.get("late_frames", 0) > math.floor(share * timing.get("frames", 0) + 1e-9))
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DatasetError(
            f"{PREFIX}timing of episode {episode} of {root} is no timing summary: {stored!r:.200}. Filter with "
            "exclude_late off, or give the episodes' numbers."
        ) from error
