"""From the numbers of episodes to summaries of brains, and to the files that hold them."""

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bhd_lerobot.evaluation import statistics
from bhd_lerobot.evaluation.metrics import EpisodeMetrics
from bhd_lerobot.evaluation.perception import PerceptionSummary, summarise_perception
from bhd_lerobot.evaluation.sequential import confidence_sequence, log_e_value
from bhd_lerobot.evaluation.statistics import Discordance, Estimate

RESULTS_NAME = "results.json"
MEANS = ("score", "reward", "length_s", "path_m", "jerk_mean", "jerk_max")
"""Numbers of an episode whose mean and interval an evaluation reports."""
ENVIRONMENT_MEANS = ("reward", "max_reward", "length_s")
"""The same of an episode in an environment of LeRobot; there rewards are compared in place of scores."""
SCORE_RANGE = (0.0, 1.0)
"""What no episode's score exceeds."""


@dataclass(frozen=True)
class BrainSummary:
    """What a brain achieved.

    Attributes:
        brain: its name in the evaluation.
        privileged: whether it acts on what no sensor measures: on the environment state that the task reports.
        episodes: how many it ran.
        successes: how many of them were a success.
        success: its success rate with its Wilson interval.
        outcomes: how many ended how, the most frequent first.
        starts: how many different initial states these episodes had; those of the same one are not independent.
        means: means with their intervals, by name, see `MEANS` and `ENVIRONMENT_MEANS`; of the episodes in which they
            are defined.
        limits: frames in which the safety filter changed the command, by kind of limit, of all episodes.
        watchdogs: frames in which a watchdog noticed something, by kind.
        estops: episodes with an emergency stop.
        faults: episodes with a latched fault.
        frames: frames of all episodes.
        perception: how well it saw; None if it does not see for itself.
    """

    brain: str
    privileged: bool
    episodes: int
    successes: int
    success: Estimate
    starts: int
    outcomes: dict[str, int]
    means: dict[str, Estimate]
    limits: dict[str, int]
    watchdogs: dict[str, int]
    estops: int
    faults: int
    frames: int
    perception: PerceptionSummary | None = None


@dataclass(frozen=True)
class PairedSummary:
    """A brain beside the baseline, on the episodes that both ran.

    Where several brains are compared with it, all their intervals hold at once with the confidence that is reported
    (Bonferroni), and p is multiplied by their number.

    Attributes:
        brain: the brain.
        baseline: what it is compared with.
        episodes: how many episodes both ran.
        success: difference of the success rates, with Newcombe's paired interval.
        differ: on how many episodes they differed in success, with McNemar's exact test.
        score: difference of the mean scores, with its interval; NaN where there are no scores.
        ratio: ratio of the mean scores, with its interval, likewise.
        rewards: differences of `reward` and `max_reward` with their intervals, in an environment of LeRobot.
        e_value: of a sequential test, the e-value against the hypothesis that both are equally good, see
            `bhd_lerobot.evaluation.sequential`; None without one. With it, the interval of `success` and `differ.p`
            hold whenever the run was stopped; those of the scores do not.
    """

    brain: str
    baseline: str
    episodes: int
    success: Estimate
    differ: Discordance
    score: Estimate
    ratio: Estimate
    e_value: float | None = None
    rewards: dict[str, Estimate] = field(default_factory=dict)


@dataclass
class EvalResults:
    """Everything an evaluation measures that does not depend on how fast the machine was.

    Attributes:
        config: what decides the numbers: robot, task, brains, episodes and seeds.
        versions: of the programs that made them.
        requested: how many episodes of each brain were requested.
        episodes: what was measured in each episode.
        brains: of each brain, by its label.
        paired: of each brain compared with the baseline, by its label.
    """

    config: dict[str, Any]
    versions: dict[str, str]
    requested: int
    episodes: list[EpisodeMetrics] = field(default_factory=list)
    brains: dict[str, BrainSummary] = field(default_factory=dict)
    paired: dict[str, PairedSummary] = field(default_factory=dict)

    @property
    def is_partial(self) -> bool:
        """Whether a brain ran fewer episodes than were requested, and not because the test ended the run."""
        return not self.is_decided and any(brain.episodes < self.requested for brain in self.brains.values())

    @property
    def is_decided(self) -> bool:
        """Whether a sequential test has shown a difference from the baseline for every other brain."""
        enough = len(self.paired) / (1 - statistics.CONFIDENCE)
        return bool(self.paired) and all((pair.e_value or 0.0) >= enough for pair in self.paired.values())

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values; what is not a number is nothing."""
        return {
            "format": "bhd-eval/1",
            "partial": self.is_partial,
            "episodes_asked": self.requested,
            "config": self.config,
            "versions": self.versions,
            "confidence": statistics.CONFIDENCE,
            "brains": {label: asdict(one) for label, one in self.brains.items()},
            "paired": {label: _without_nothing(asdict(one)) for label, one in self.paired.items()},
            "episodes": [episode.plain() for episode in self.episodes],
        }


def summarise(
    config: dict[str, Any],
    versions: dict[str, str],
    episodes: Mapping[str, Sequence[EpisodeMetrics]],
    requested: int,
    baseline: str,
    *,
    privileged: Collection[str] = (),
    sequential: bool = False,
    means: Sequence[str] = MEANS,
) -> EvalResults:
    """Return the summaries of brains after some episodes, with the means of these numbers.

    Those of a sequential test hold whenever it was stopped.
    """
    results = EvalResults(config, versions, requested)
    compared = max(1, len(episodes) - 1)
    for label, ran in episodes.items():
        results.episodes += ran
        results.brains[label] = _brain(label, ran, label in privileged, means)
        if label != baseline:
            results.paired[label] = _pair(ran, episodes[baseline], label, baseline, compared, is_sequential=sequential)
            if "score" not in means:
                results.paired[label] = _with_rewards(results.paired[label], ran, episodes[baseline], compared)
    return results


def _brain(label: str, episodes: Sequence[EpisodeMetrics], privileged: bool, names: Sequence[str]) -> BrainSummary:
    successes = sum(episode.success for episode in episodes)
    means = {}
    for name in names:
        values = np.array([getattr(episode, name) for episode in episodes], np.float64)
        within = SCORE_RANGE if name == "score" else (-math.inf, math.inf)
        means[name] = statistics.mean(values[np.isfinite(values)], within=within)
    return BrainSummary(
        brain=label,
        privileged=privileged,
        episodes=len(episodes),
        successes=successes,
        success=statistics.wilson(successes, len(episodes)),
        starts=len({episode.initial_state or episode.episode for episode in episodes}),
        outcomes=dict(Counter(episode.outcome for episode in episodes).most_common()),
        means=means,
        limits=_sum(episode.limits for episode in episodes),
        watchdogs=_sum(episode.watchdogs for episode in episodes),
        estops=sum(episode.estops for episode in episodes),
        faults=sum(episode.faults for episode in episodes),
        frames=sum(episode.frames for episode in episodes),
        perception=summarise_perception([episode.perception for episode in episodes]),
    )


def _pair(
    episodes: Sequence[EpisodeMetrics],
    others: Sequence[EpisodeMetrics],
    label: str,
    baseline: str,
    compared: int,
    *,
    is_sequential: bool,
) -> PairedSummary:
    confidence = 1 - (1 - statistics.CONFIDENCE) / compared
    by_number = {metrics.episode: metrics for metrics in others}
    pairs = [(episode, by_number[episode.episode]) for episode in episodes if episode.episode in by_number]
    success = [one.success for one, _ in pairs], [other.success for _, other in pairs]
    score = [one.score for one, _ in pairs], [other.score for _, other in pairs]
    differ = statistics.discordance(*success)
    rate, e_value = statistics.rate_difference(*success, confidence), None
    if is_sequential:
        better, worse = differ.better, differ.worse
        e_value = math.exp(min(700.0, float(log_e_value(better, worse))))
        rate = confidence_sequence(better, worse, len(pairs) - better - worse, confidence)
        differ = replace(differ, p=min(1.0, 1 / e_value))
    return PairedSummary(
        brain=label,
        baseline=baseline,
        episodes=len(pairs),
        success=rate,
        differ=replace(differ, p=min(1.0, compared * differ.p)),
        score=statistics.mean_difference(*score, confidence, within=SCORE_RANGE),
        ratio=statistics.ratio_of_means(*score, confidence, within=SCORE_RANGE),
        e_value=e_value,
    )


def _with_rewards(
    pair: PairedSummary, episodes: Sequence[EpisodeMetrics], others: Sequence[EpisodeMetrics], compared: int
) -> PairedSummary:
    """Return a pair with rewards, which may be any numbers, in place of scores."""
    confidence = 1 - (1 - statistics.CONFIDENCE) / compared
    by_number = {metrics.episode: metrics for metrics in others}
    rewards = {}
    for name in ("reward", "max_reward"):
        values = [
            (getattr(one, name), getattr(by_number[one.episode], name)) for one in episodes if one.episode in by_number
        ]
        rewards[name] = statistics.mean_difference([a for a, _ in values], [b for _, b in values], confidence)
    undefined = Estimate(math.nan, math.nan, math.nan)
    return replace(pair, score=undefined, ratio=undefined, rewards=rewards)


def _without_nothing(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _sum(counts: Any) -> dict[str, int]:
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)  # keeps kinds that never occurred
    return dict(total)


def write_json(path: Path, values: Any) -> None:
    """Write plain values as JSON, all or nothing; numbers that JSON does not have become null."""
    part = path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(_finite(values), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)


def write_table(path: Path, episodes: Sequence[EpisodeMetrics]) -> None:
    """Write a Parquet file with a row for each episode; counts by kind and details have columns of their own."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    for episode in episodes:
        row: dict[str, Any] = {}
        for name, value in episode.plain().items():
            if isinstance(value, dict):
                row |= {f"{name}.{kind}": number for kind, number in value.items()}
            else:
                row[name] = value
        rows.append(row)
    names = dict.fromkeys(name for row in rows for name in row)
    pq.write_table(pa.table({name: [row.get(name) for row in rows] for name in names}), path)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
