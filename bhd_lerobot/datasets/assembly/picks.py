"""Episodes on their way into another dataset, and the files that they share on the way."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.columns import frames_of, instructions_of
from bhd_lerobot.datasets.format.state import DatasetState, Row, ordered_slots, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.layout import Slot


@dataclass(frozen=True)
class Pick:
    """An episode that goes into a new dataset.

    Attributes:
        metadata: metadata columns that get another value, by name without prefix.
        columns: columns of its frames that get other values, shape (T,).
    """

    source: DatasetState
    row: Row
    metadata: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """Successive picks that lie in one file.

    Attributes:
        whole: whether they are all episodes of that file, in its order.
        share: the share of the file's frames that they have.
    """

    source: DatasetState
    slot: Slot
    places: tuple[int, ...]
    whole: bool
    share: float


@dataclass
class Group:
    """What goes into one new file."""

    target: Slot
    runs: list[Run]

    @property
    def is_in_place(self) -> bool:
        """Whether it is a file of its dataset, unchanged and under its own number."""
        return len(self.runs) == 1 and self.runs[0].whole and self.runs[0].slot == self.target


class Files:
    """The episodes of each file, computed once for each dataset."""

    def __init__(self, picks: Sequence[Pick]) -> None:
        self._picks = picks
        self._rows: dict[tuple[int, str], dict[Slot, list[Row]]] = {}
        self._tasks: dict[tuple[int, Slot], dict[int, tuple[NDArray[np.int64], list[str]]]] = {}

    def rows(self, source: DatasetState, kind: str) -> dict[Slot, list[Row]]:
        """Return the rows of every file of a kind (`slot_of`) in a dataset."""
        key = (id(source), kind)
        if key not in self._rows:
            self._rows[key] = ordered_slots(source.rows, kind)
        return self._rows[key]

    def task_indexes(self, pick: Pick) -> NDArray[np.int64]:
        """Return the number of the instruction of each frame of an episode, shape (T,); see `instructions`."""
        return self._of_frames(pick)[0]

    def instructions(self, pick: Pick) -> list[str]:
        """Return the instructions of an episode: those of its frames, whatever its row says."""
        return self._of_frames(pick)[1]

    def _of_frames(self, pick: Pick) -> tuple[NDArray[np.int64], list[str]]:
        slot = slot_of(pick.row, "data")
        key, path = (id(pick.source), slot), pick.source.root / layout.data_file(slot)
        if key not in self._tasks:
            rows = self.rows(pick.source, "data")[slot]
            frames = frames_of(path, rows, ["task_index"])
            found = [(row, frames[row["episode_index"]]["task_index"].to_numpy()) for row in rows]
            self._tasks[key] = {
                row["episode_index"]: (own, instructions_of(row, own, pick.source.tasks, path)) for row, own in found
            }
        return self._tasks[key][pick.row["episode_index"]]

    def runs(self, kind: str) -> Iterator[Run]:
        """Yield the runs of picks, in order."""
        places: list[int] = []
        for place, pick in enumerate(self._picks):
            if places:
                last = self._picks[places[-1]]
                if last.source is not pick.source or slot_of(last.row, kind) != slot_of(pick.row, kind):
                    yield self._run(kind, places)
                    places = []
            places.append(place)
        if places:
            yield self._run(kind, places)

    def _run(self, kind: str, places: list[int]) -> Run:
        source = self._picks[places[0]].source
        slot = slot_of(self._picks[places[0]].row, kind)
        rows, own = self.rows(source, kind)[slot], [self._picks[place].row for place in places]
        whole = len(rows) == len(own) and all(a is b for a, b in zip(rows, own, strict=True))
        share = sum(row["length"] for row in own) / sum(row["length"] for row in rows)
        return Run(source, slot, tuple(places), whole, share)


@dataclass(frozen=True)
class Plan:
    """A dataset that is being assembled."""

    picks: Sequence[Pick]
    rows: Sequence[Row]
    tasks: Mapping[str, int]
    info: Mapping[str, Any]
    files: Files
    _renumbered: dict[int, NDArray[np.int64]] = field(default_factory=dict)

    def task_indexes(self, place: int) -> NDArray[np.int64]:
        """Return the new number of the instruction of each frame of an episode, shape (T,)."""
        source = self.picks[place].source
        if id(source) not in self._renumbered:
            self._renumbered[id(source)] = np.array([self.tasks.get(task, -1) for task in source.tasks])
        return self._renumbered[id(source)][self.files.task_indexes(self.picks[place])]
