"""Sensors that read the same all the time, in an episode or in all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.validate.findings import Findings, name_of
from bhd_lerobot.errors import brief

_SHORTEST = 10  # frames; in fewer, a number may well stand still
_SHOWN = 3  # episodes that are named one by one


@dataclass
class _Column:
    """One feature, over the episodes so far; an entry for each file."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    frozen: list[NDArray[np.bool_]] = field(default_factory=list)  # shape (episodes, d)
    level: list[NDArray[np.float64]] = field(default_factory=list)  # first values, shape (episodes, d)
    lengths: list[NDArray[np.int64]] = field(default_factory=list)
    episodes: list[int] = field(default_factory=list)


class FrozenCheck:
    """The check for numbers that stand still, over all files."""

    def __init__(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        self._features = features
        self._columns: dict[str, _Column] = {}

    def add(
        self,
        key: str,
        values: NDArray[Any],
        starts: NDArray[np.int64],
        lengths: NDArray[np.int64],
        episodes: Sequence[int],
    ) -> None:
        """Add the values of a feature in some episodes.

        Args:
            values: its finite numbers, shape (frames, d).
            starts: first row of each episode, shape (episodes,).
            lengths: frames of each episode, shape (episodes,).
        """
        low, high = values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64)
        known = self._columns.setdefault(key, _Column(low, high))
        known.low, known.high = np.minimum(known.low, low), np.maximum(known.high, high)
        known.frozen.append(_frozen(values, starts, lengths))
        known.level.append(values[starts].astype(np.float64))
        known.lengths.append(lengths)
        known.episodes += episodes

    def judge(self, findings: Findings) -> None:
        """Add what was found to the findings."""
        for key, column in self._columns.items():
            self._judge(key, column, findings)

    def _judge(self, key: str, column: _Column, findings: Findings) -> None:
        frozen, level = np.concatenate(column.frozen), np.concatenate(column.level)
        usable = np.concatenate(column.lengths) >= _SHORTEST
        if not usable.any():
            return
        dead = column.low == column.high
        if dead.all():
            findings.warning("frozen", key, "its values never change", "Check that it was connected.")
            return
        if dead.any():
            names = brief(name_of(self._features[key], int(i)) for i in np.flatnonzero(dead))
            findings.note("frozen", key, f"these never change: {names}")
        if key == keys.ACTION:
            return  # a brain may well want the same all the time; a sensor that reads the same is broken
        whole = (frozen | dead).all(axis=1) & usable
        for position in np.flatnonzero(whole)[:_SHOWN]:
            what = f"nothing changes in episode {column.episodes[position]}"
            findings.warning("frozen", key, what, "Leave the episode out (dataset.episodes), or record it again.")
        # A number that stands still in most episodes does so by its nature; one at the end of its range may be clipped.
        odd = (frozen[usable].mean(axis=0) <= 0.5) & ~dead
        still = frozen & (usable & ~whole)[:, None] & odd & (level > column.low) & (level < column.high)
        for element in np.flatnonzero(still.any(axis=0)).tolist():
            episodes = brief(column.episodes[i] for i in np.flatnonzero(still[:, element]))
            what = f"it does not change in episode {episodes}, and does in most others"
            where = f"{key}: {name_of(self._features[key], element)}"
            findings.warning("frozen", where, what, "Check the sensor.")


def _frozen(values: NDArray[Any], starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which numbers do not change in each episode, shape (episodes, d)."""
    first = values[starts]
    # Most numbers differ between the first frame and one in the middle or the last, so few are left to compare.
    same = (first == values[starts + lengths // 2]) & (first == values[starts + lengths - 1])
    for episode, element in zip(*np.nonzero(same), strict=True):
        rows = slice(starts[episode], starts[episode] + lengths[episode])
        same[episode, element] = (values[rows, element] == first[episode, element]).all()
    return same
