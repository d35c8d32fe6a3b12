"""The rows of a section's table, from what was measured."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

import numpy as np
from scipy.stats import sem
from scipy.stats import t as student

from benchmarks._report import Row, mean, rate
from benchmarks.results.runner import Part
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.evaluation.statistics import Estimate, mean_difference, rate_difference, ratio_of_means, wilson
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.task import episode_seed

_RESAMPLES, _SEED = 10_000, 0


@dataclass(frozen=True)
class Rows:
    """Makes the rows; each method but `make` is a kind of row.

    Attributes:
        section: whose rows are made, which is also the name of the part that is meant where none is named.
        parts: what was measured, by the part's name and the training seed; the seed is None of what was run once.
        seeds: of the trainings.
    """

    section: str
    parts: Mapping[tuple[str, int | None], Part]
    seeds: Sequence[int]

    def make(self, spec: Mapping[str, Any], words: Mapping[str, Any]) -> Iterator[Row]:
        """Yield the rows of an entry of the table; none of a part that was not measured.

        Args:
            spec: the kind and its reference, and what else is said of it.
            words: what it was filled with; its `seed`, or else the first that was measured.
        """
        kind, (ref, spec) = next(iter(spec)), (next(iter(spec.values())), dict(spec))
        refs = ref if isinstance(ref, list) else [ref]
        names = {one.partition(":")[0] if ":" in one else self.section for one in refs}
        seeds: list[Any] = [seed for seed in self.seeds if all((name, seed) in self.parts for name in names)]
        if "seed" in words:
            seeds = [seed for seed in seeds if seed == words["seed"]]
        elif not seeds and all((name, None) in self.parts and self.parts[name, None].measured for name in names):
            seeds = [None]  # of what is run once
        if seeds:
            yield from getattr(self, f"_{kind}")(spec, refs, seeds)

    def _get(self, ref: str, seed: int) -> Any:
        """Return what `PART:KEY/KEY` names."""
        part, _, path = ref.rpartition(":")
        found = self.parts[part or self.section, seed].measured
        for key in path.split("/"):
            found = found.get(key) if isinstance(found, dict) else None
        return found

    def _brain(self, ref: str, seed: int) -> Any:
        before, _, name = ref.replace("{seed}", str(seed)).rpartition("/")
        if not before and ":" in name:
            part, _, name = name.partition(":")
            return self._get(f"{part}:brains/{name}", seed)
        return self._get(f"{before}/brains/{name}" if before else f"brains/{name}", seed)

    def _success(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        brain = self._brain(refs[0], seeds[0])
        # Results of an earlier version do not say what is privileged.
        told = ", from privileged state" if brain.get("privileged", spec.get("privileged")) else ""
        name = spec.get("shown", re.split("[/:]", refs[0])[-1])
        what = f"{spec.get('before', '')}{name}{told}: success in {brain['episodes']}"
        value = rate(brain["success"], brain["outcomes"]) + _beside_chance(spec, brain["episodes"])
        yield _judged(what, value, spec, brain["success"])

    def _score(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        name = spec.get("shown", re.split("[/:]", refs[0])[-1])
        yield Row(f"{name}: mean score", mean(self._brain(refs[0], seeds[0])["means"]["score"]))

    def _mean(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        """The mean success of policies that differ in their training seeds only; none if there is one."""
        brains = [self._brain(refs[0], seed) for seed in seeds]
        if len(brains) > 1:
            rates, (episodes,) = [float(one["success"]["value"]) for one in brains], {one["episodes"] for one in brains}
            value = over_seeds(rates, episodes) + _beside_chance(spec, episodes)
            yield Row(f"{spec['what']}: mean success over {len(rates)} trainings", value)

    def _difference(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        one, other = (self._brain(ref, seeds[0])["scores"] for ref in refs)
        found = asdict(mean_difference(one, other, within=SCORE_RANGE))
        yield _judged(f"{spec['what']}: mean score, paired", mean(found, "+"), spec, found)

    def _ratio(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        one, other = (self._brain(ref, seeds[0])["scores"] for ref in refs)
        found = asdict(ratio_of_means(one, other, within=SCORE_RANGE))
        value = mean(found) + self._unmoved(spec, seeds[0])
        yield _judged(f"{spec['what']}: mean score, paired", value, spec, found)

    def _more_successes(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        # An episode of the pick task has the score 1 if it is a success, and less otherwise.
        one, other = ([score == 1 for score in self._brain(ref, seeds[0])["scores"]] for ref in refs)
        found = {key: 100 * value for key, value in asdict(rate_difference(one, other)).items()}
        value = f"{found['value']:+.1f} points ({found['low']:+.1f} to {found['high']:+.1f})"
        yield _judged(f"{spec['what']}: success, paired", value, spec, found)

    def _failures(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        own, *others = (int(one["episodes"] - one["successes"]) for one in (self._brain(ref, seeds[0]) for ref in refs))
        more = own - sum(others)
        yield _judged(spec["what"], str(more), spec, {"value": more})

    def _seconds(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        found = [self._get(refs[0], seed) for seed in seeds]
        yield _judged(spec["what"], ", ".join(f"{one:.0f} s" for one in found), spec, {"value": found[0]})

    def _count(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        count = self._get(refs[0], seeds[0])
        if count is not None:
            yield Row(spec["what"], f"{count:,}{self._unmoved(spec, seeds[0])}")

    def _unmoved(self, spec: dict[str, Any], seed: int) -> str:
        return "; PPO kept the start" if "if_0" in spec and self._get(spec["if_0"], seed) == 0 else ""

    def _rounds(self, _: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        for row in self._get(refs[0], seeds[0]) or ():
            what = f"seed_{seeds[0]}, round {row['round']}, from {row['episodes']} episodes: success in validation"
            yield Row(what, rate(row["success"], {}))

    def _recovered(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        paths = [ref.replace("/", "/successes/") for ref in refs]
        found = dict(
            zip(("value", "low", "high"), recovered(*(self._get(one, seeds[0]) for one in paths)), strict=True)
        )
        text = f"{100 * found['value']:.0f} % ({100 * found['low']:.0f} to {100 * found['high']:.0f})"
        value = "not defined: nothing was lost" if math.isnan(found["value"]) else text
        yield _judged(f"{spec['what']}, share of what was lost", value, spec, found)

    def _perceived(self, _: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        saw = self._get(refs[0], seeds[0])
        median, most, _far = (1000 * (math.nan if value is None else value) for value in saw["error_m"])
        training = "" if seeds[0] is None else f"seed_{seeds[0]}: "
        what = f"{training}in {saw['episodes']} tables, randomised"
        yield Row(f"{what}: error of what was asked for", f"median {median:.1f} mm, 90 % below {most:.1f} mm")
        yield Row(f"{what}: wrong object", rate(saw["wrong"], {}))
        yield Row(f"{what}: within the radius stated for 90 %", rate(saw["in_90"], {}))

    def _another(self, spec: dict[str, Any], refs: list[str], seeds: list[int]) -> Iterator[Row]:
        """How often a brain takes another object than the one that is named."""
        brain = self._brain(refs[0], seeds[0])
        found = asdict(wilson(brain["outcomes"].get("wrong_object", 0), brain["episodes"]))
        by_chance = f"; chance {100 * (1 - chance(brain['episodes'])):.1f} %"
        yield Row(f"{spec['shown']} takes another object, in {brain['episodes']}", rate(found, {}) + by_chance)


def _judged(what: str, value: str, spec: Mapping[str, Any], found: Mapping[str, float | None]) -> Row:
    goal = spec.get("goal", "")
    return Row(what, value, goal, is_met(goal, found) if goal else None)


def is_met(goal: str, found: Mapping[str, float | None]) -> bool:
    """Return whether a number meets a goal: "[lower end|upper end|its interval] at least|at most|above N[ %]", ….

    Args:
        goal: the words; several with commas between them.
        found: the `value`, and the ends of its interval `low` and `high`, which are the value where it has none.
    """
    for clause in goal.split(", "):
        end, relation, number, percent = re.match(
            r"(lower end |upper end |its interval |)(at least|at most|above) (-?[\d.]+)( %|)", clause
        ).groups()  # type: ignore[union-attr]
        key = {"": "value", "upper end ": "high"}.get(end, "low")
        value, limit = found.get(key), float(number) / (100 if percent else 1)
        if value is None or math.isnan(value):
            value = found["value"]
        assert value is not None
        if not {"at least": value >= limit, "at most": value <= limit, "above": value > limit}[relation]:
            return False
    return True


def _beside_chance(spec: Mapping[str, Any], episodes: int) -> str:
    return f"; chance {100 * chance(episodes, int(spec['least_objects'])):.1f} %" if "least_objects" in spec else ""


def chance(episodes: int, least: int = 1) -> float:
    """Return how often an object is the one that is meant if it is drawn from those on the table.

    Args:
        episodes: the first ones of evaluation seed 0.
        least: smallest number of objects on the table.
    """
    task = PickTask(PickConfig(min_objects=least), n=1, fps=10)
    scenes = (task.sample(episode_seed(0, episode, "held_out")) for episode in range(episodes))
    return fmean(1 / len(scene.objects) for scene in scenes)


def over_seeds(rates: Sequence[float], episodes: int) -> str:
    """Return the mean success of policies from several training seeds, with its interval, and each of their rates."""
    found = over_trainings(rates, episodes)
    return f"{rate(asdict(found), {})}; {', '.join(f'{100 * one:.1f} %' for one in rates)}"


def over_trainings(rates: Sequence[float], episodes: int) -> Estimate:
    """Return the mean success of several trainings that meet the same episodes, with a 95 % interval over both.

    Other trainings would have other rates, and other episodes would shift them all alike. The widths of Student's
    interval over the trainings and of Wilson's over the episodes, of which no training sees others, are added as
    independent errors are: the method of G. Y. Zou and A. Donner, Statistics in Medicine 27 (2008). Student's is not
    corrected for skewness, which three values do not tell, and takes trainings that fail now and then for improbable,
    if none of these did.

    Args:
        rates: one of each training, at least two.
        episodes: how many there are.
    """
    value = sum(rates) / len(rates)
    own, half = wilson(round(value * episodes), episodes), student.ppf(0.975, len(rates) - 1) * sem(rates)
    low, high = (math.hypot(half, own.value - end) for end in (own.low, own.high))
    return Estimate(value, max(0.0, value - low), min(1.0, value + high))


def recovered(before: Sequence[bool], lost: Sequence[bool], found: Sequence[bool]) -> tuple[float, float, float]:
    """Return which share of what a shift cost was recovered, with its 95 % interval by a paired bootstrap.

    Args:
        before: successes without the shift, by seed.
        lost: with it, of the same policy and the same seeds.
        found: with it, of the policy that was adapted.

    Returns:
        the share, and both ends of its interval; all NaN if the shift cost nothing. Where it costs nothing in a
        resample, the share of that is infinite, to the side of what was gained.
    """
    outcomes = np.array([before, lost, found], float)
    if outcomes.shape[1] == 0 or outcomes[0].mean() <= outcomes[1].mean():
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(_SEED)
    picks = rng.integers(0, outcomes.shape[1], (_RESAMPLES, outcomes.shape[1]))
    means = np.array([row[picks].mean(axis=1) for row in outcomes])
    cost, gain = means[0] - means[1], means[2] - means[1]
    shares = np.where(gain >= 0, np.inf, -np.inf)
    np.divide(gain, cost, out=shares, where=cost > 0)
    low, high = np.quantile(shares, (0.025, 0.975), method="nearest")
    whole = outcomes.mean(axis=1)
    return float((whole[2] - whole[1]) / (whole[0] - whole[1])), float(low), float(high)
