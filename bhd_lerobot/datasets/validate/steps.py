"""What changes from one frame to the next in a way that nothing real does: actions that jump, quaternions that flip."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.poses import quaternion_columns
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.validate.findings import Findings, name_of

_JUMP_OF_RANGE, _JUMP_OF_USUAL = 0.5, 5.0  # a jump: more than that of the range, and of what is usual


@dataclass
class _Steps:
    """Steps from one frame to the next that stand out."""

    episode: int
    frame: int  # of the first of them
    count: int = 0
    episodes: set[int] = field(default_factory=set)

    def __str__(self) -> str:
        often = "once" if self.count == 1 else f"{self.count} times in {len(self.episodes)} episodes"
        return f"{often}, {'in' if self.count == 1 else 'first in'} episode {self.episode}, frame {self.frame}"


class StepCheck:
    """The check of steps, over all files."""

    def __init__(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        self._features = features
        self._flips: dict[tuple[str, str], _Steps] = {}  # by feature and name
        self._jumps: dict[tuple[str, str], _Steps] = {}

    def add(self, key: str, values: NDArray[Any], starts: NDArray[np.int64], episodes: Sequence[int]) -> None:
        """Add the values of a feature in some episodes.

        Args:
            values: its finite numbers, shape (frames, d).
            starts: first row of each episode, shape (episodes,).
        """
        if len(values) < 2:
            return
        step = np.diff(values.astype(np.float64), axis=0)
        step[starts[1:] - 1] = 0.0  # from one episode to the next
        for first in quaternion_columns(keys.names_of(self._features[key])):
            part = slice(first, first + 4)
            # The nearer of two signs is the other one: the orientation continues, its numbers do not.
            flips = (step[:, part] ** 2).sum(axis=1) > 2.0
            if flips.any():
                name = name_of(self._features[key], first).removesuffix(".pos").removesuffix("_qw")
                _add(self._flips, (key, name), np.flatnonzero(flips), starts, episodes)
                step[flips, part] = 0.0
        if key != keys.ACTION:
            return
        span = values.max(axis=0) - values.min(axis=0)
        large = np.abs(step) > _JUMP_OF_RANGE * span
        # One command to close a gripper in an episode is usual. Two opposite steps in two frames are not.
        back = np.zeros_like(large)
        back[:-1] = large[:-1] & large[1:] & (step[:-1] * step[1:] < 0)
        back[1:] |= back[:-1]
        usual, more_usual = np.quantile(np.abs(step), (0.99, 0.95), axis=0)
        limit = np.where(back, more_usual, usual)
        jumps = large & (np.abs(step) > _JUMP_OF_USUAL * limit) & (span > 0)
        for element in np.flatnonzero(jumps.any(axis=0)).tolist():
            name = name_of(self._features[key], element)
            _add(self._jumps, (key, name), np.flatnonzero(jumps[:, element]), starts, episodes)

    def judge(self, findings: Findings) -> None:
        """Add what was found to the findings."""
        for (key, name), steps in self._flips.items():
            what = (
                f"the quaternion changes its sign {steps}: the same orientation, written with other numbers; a network "
                "that learns both predicts what lies between them"
            )
            findings.warning("jumps", f"{key}: {name}", what, "Use one sign if a policy is to predict it.")
        for (key, name), steps in self._jumps.items():
            what = f"it jumps by more than half its range {steps}"
            findings.warning("jumps", f"{key}: {name}", what, "Check the episode with bhd-data view.")


def _add(
    kind: dict[tuple[str, str], _Steps],
    what: tuple[str, str],
    rows: NDArray[np.intp],
    starts: NDArray[np.int64],
    episodes: Sequence[int],
) -> None:
    inside = np.searchsorted(starts, rows + 1, side="right") - 1
    numbers = [episodes[place] for place in inside.tolist()]
    known = kind.setdefault(what, _Steps(numbers[0], int(rows[0] + 1 - starts[inside[0]])))
    known.count += len(rows)
    known.episodes.update(numbers)
