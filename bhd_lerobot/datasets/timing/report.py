"""The timing of a dataset, read and summed up."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.timing import TimingSummary
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_columns
from bhd_lerobot.datasets.format.summary import EpisodeSummary, dataset_info
from bhd_lerobot.errors import DatasetError

_COLUMNS = (keys.TIME, keys.AGE, *keys.PUNCTUALITY)

_GRANT = {"name", "wanted", "granted", "detail", "remedy"}
_MOST = 1e18  # of counts and seconds: beyond it is no measurement
CLOCKS = ("lockstep", "realtime")

SIMULATED = (
    "Time was simulated (clock: lockstep). It stood still during inference and while a tick was computed, so nothing "
    "could be late; this dataset does not show the timing of this machine."
)


@dataclass(frozen=True)
class EpisodeTiming:
    """The timing of one episode, or of several together.

    Attributes:
        name: the episode's number, or "all".
        summary: what was stored about it.
        columns: the timing columns by key, each of shape (frames,).
        intervals: time between one observation and the next of the same episode [s], shape (frames - 1,).
        grants: what the control loop requested from the operating system, each with `name`, `wanted`, `granted`,
            `detail` and `remedy`; empty on a simulated clock.
    """

    name: str
    summary: TimingSummary
    columns: dict[str, NDArray]
    intervals: NDArray[np.float64]
    grants: tuple[dict[str, Any], ...] = ()

    def values(self) -> dict[str, Any]:
        """Return everything but the columns as plain values, times in seconds."""
        return {
            **asdict(self.summary),
            "age": quantiles(self.columns[keys.AGE]),
            "interval": quantiles(self.intervals),
            "realtime": list(self.grants),
        }


@dataclass(frozen=True)
class TimingReport:
    """The timing of a dataset.

    Attributes:
        root: where it lies.
        fps: frames per second.
        episodes: the requested ones.
    """

    root: Path
    fps: int
    episodes: tuple[EpisodeTiming, ...]

    @property
    def simulated(self) -> bool:
        """Whether no episode was recorded on the wall clock."""
        return all(episode.summary.clock == "lockstep" for episode in self.episodes)

    @cached_property
    def total(self) -> EpisodeTiming:
        """All episodes together.

        Counts are sums, maxima maxima. The quantiles of ticks are those of the worst episode, an upper bound of what
        they are over all; the rate error is the largest one. Ages, intervals and inference times are exact.
        """
        parts = [episode.summary for episode in self.episodes]

        def summed(name: str) -> Any:
            return sum(getattr(part, name) for part in parts)

        def worst(name: str) -> Any:
            return max(getattr(part, name) for part in parts)

        columns = {key: np.concatenate([episode.columns[key] for episode in self.episodes]) for key in _COLUMNS}
        inference = quantiles(columns[keys.INFERENCE_TIME])
        summary = replace(
            parts[0],
            **{name: summed(name) for name in ("ticks", "overruns", "skipped", "frames", "late_frames", "drops")},
            **{name: worst(name) for name in ("lateness_p50", "lateness_p99", "lateness_max", "age_max", "period")},
            **{name: worst(name) for name in ("duration_p50", "duration_p99", "duration_max")},
            inference_p50=inference["p50"],
            inference_p99=inference["p99"],
            inference_max=inference["max"],
            elapsed=summed("elapsed"),
            rate_error=max((part.rate_error for part in parts), key=abs),
            clock="lockstep" if self.simulated else "realtime",
            tolerated=parts[0].tolerated if all(part.tolerated == parts[0].tolerated for part in parts) else {},
        )
        return EpisodeTiming("all", summary, columns, np.concatenate([episode.intervals for episode in self.episodes]))

    @property
    def grants(self) -> list[tuple[str, tuple[dict[str, Any], ...]]]:
        """What was requested from the operating system and granted, with the episodes of each."""
        found: dict[str, list[EpisodeTiming]] = {}
        for episode in self.episodes:
            if episode.grants:
                found.setdefault(json.dumps(episode.grants, sort_keys=True), []).append(episode)
        return [(_ranges([int(episode.name) for episode in group]), group[0].grants) for group in found.values()]

    def values(self) -> dict[str, Any]:
        """Return everything but the columns as plain values, times in seconds."""
        return {
            "root": str(self.root),
            "fps": self.fps,
            "clock": self.total.summary.clock,
            "all": self.total.values(),
            "episodes": [{"index": int(episode.name), **episode.values()} for episode in self.episodes],
        }


def timing_of(episode: EpisodeSummary) -> TimingSummary | None:
    """Return the timing summary that was stored with an episode; None if there is none."""
    if "timing" not in episode.metadata:
        return None
    try:
        summary = TimingSummary.from_fields(_stored(episode, "timing"))
    except TypeError as error:
        raise DatasetError(f"The timing summary of episode {episode.index} is not complete: {error}.") from error
    for name, value in asdict(summary).items():
        limits = value.values() if name == "tolerated" and isinstance(value, dict) else [value]
        if value not in CLOCKS if name == "clock" else not all(map(_is_number, limits)):
            raise DatasetError(f"The timing summary of episode {episode.index} is wrong: {name} is {value!r:.80}.")
    return summary if summary.frames else replace(summary, frames=episode.frames)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MOST


def _grants_of(episode: EpisodeSummary) -> tuple[dict[str, Any], ...]:
    if not episode.metadata.get("realtime"):
        return ()
    grants = _stored(episode, "realtime")
    if not isinstance(grants, list) or not all(isinstance(grant, dict) and grant.keys() >= _GRANT for grant in grants):
        raise DatasetError(f"bhd/realtime of episode {episode.index} is no list of grants: {grants!r:.200}.")
    return tuple(grants)


def load_timing(root: Path | str, episode: int | None = None) -> TimingReport:
    """Return the timing of one episode of a dataset, or of all."""
    info = dataset_info(root)
    columns = read_columns(root, _COLUMNS, episode)
    chosen = info.episodes if episode is None else (info.episodes[episode],)
    if not chosen:
        raise DatasetError(f"{info.root} holds no episode yet, so there is no timing to report.")
    found = []
    for one, stored in zip(chosen, columns, strict=True):
        summary = timing_of(one)
        if summary is None or keys.TIME not in stored:
            raise DatasetError(
                f"{info.root} has no timing: it has no column {keys.TIME!r} or no timing summaries, so "
                "another program recorded it. `bhd-record` stores both."
            )
        # Columns that a version before this did not know: it recorded on the simulated clock only.
        zeros = {key: np.zeros(one.frames, keys.SCALARS[key][0]) for key in _COLUMNS}
        grants = _grants_of(one)
        intervals = np.diff(stored[keys.TIME])
        found.append(EpisodeTiming(str(one.index), summary, {**zeros, **stored}, intervals, grants))
    return TimingReport(info.root, info.fps, tuple(found))


def _stored(episode: EpisodeSummary, name: str) -> Any:
    try:
        return json.loads(episode.metadata[name])
    except (TypeError, ValueError, RecursionError) as error:
        text = episode.metadata[name]
        raise DatasetError(f"bhd/{name} of episode {episode.index} is not JSON: {text!r:.200} ({error}).") from error


def quantiles(values: NDArray) -> dict[str, float]:
    """Return `p50`, `p99`, `min` and `max` of an array; zeros if it is empty."""
    if not values.size:
        return dict.fromkeys(("p50", "p99", "min", "max"), 0.0)
    middle, high = np.quantile(values, (0.50, 0.99), method="inverted_cdf")
    return {"p50": float(middle), "p99": float(high), "min": float(values.min()), "max": float(values.max())}


def _ranges(numbers: Sequence[int]) -> str:
    """Return episodes as text: "episode 3", or "episodes 0-4, 7"."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    ranges = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)
    return f"episode{'s' * (len(numbers) > 1)} {ranges}"
