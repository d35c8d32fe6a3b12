"""Whether the numbers of a dataset can be learned from: finite, alive, within limits, and where they say they are.

Data files are read one after the other, so that memory holds two of them.
"""

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import numbers
from bhd_lerobot.datasets.format.expected import wrong_columns
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import Row, ordered_slots
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.validate.files import RESTORE, Files, stats_remedy
from bhd_lerobot.datasets.validate.findings import Findings, name_of, one_line
from bhd_lerobot.datasets.validate.frozen import FrozenCheck
from bhd_lerobot.datasets.validate.order import check_numbers
from bhd_lerobot.datasets.validate.statistics import UNREAD, Moments, wrong_deviations, wrong_statistic
from bhd_lerobot.datasets.validate.steps import StepCheck
from bhd_lerobot.errors import brief

Limits = Mapping[str, Mapping[str, tuple[float, float]]]
"""Feature -> name of one of its numbers -> least and largest value."""

_TIMESTAMP_TOLERANCE = 1e-4  # [s] LeRobot's own
_LEAVE = "Leave the episode out (dataset.episodes), or record it again."
_MOVING = (keys.OBSERVATION_STATE, keys.ACTION)  # these should change; the environment state often does not, by design
_LIMIT_TOLERANCE = 0.01  # of the limits' distance: a joint gives way a little at its end
_LATE_SHARE = 0.01


class ValueCheck:
    """The check of all numbers."""

    def __init__(self, files: Files, findings: Findings, limits: Limits | None = None) -> None:
        self.frames = 0
        self._files, self._findings, self._limits = files, findings, limits or {}
        self._columns: dict[str, Moments] = {}
        self._longest = 0  # frames of an episode
        # By feature: how many frames are not finite, and where the first is, for each file.
        self._broken: dict[str, list[tuple[int, str]]] = {}
        self._frozen, self._steps = FrozenCheck(files.features), StepCheck(files.features)
        self._counted = Counter[str]()  # late frames, skipped ticks

    def run(self) -> None:
        """Read everything."""
        slots = [
            (layout.data_file(slot), rows)
            for slot, rows in ordered_slots(self._files.rows, "data").items()
            if (self._files.root / layout.data_file(slot)).is_file()
        ]
        # The next file is read while one is checked. Findings are added to a list, which is thread-safe.
        with ThreadPoolExecutor(1) as reader:
            tables = deque(reader.submit(self._read, name) for name, _ in slots[:1])
            for (name, rows), following in zip(slots, [*slots[1:], None], strict=False):
                table = tables.popleft().result()
                if following is not None:
                    tables.append(reader.submit(self._read, following[0]))
                if table is not None and (table := self._in_order(name, table, rows)) is not None:
                    columns = [key for key in table.column_names if key in self._files.features]
                    self._check_table(table.select(columns), rows)
        self._judge_columns()
        self._frozen.judge(self._findings)
        self._steps.judge(self._findings)
        self._judge_stats()
        if self.frames and self._counted[keys.LATE] > _LATE_SHARE * self.frames:
            what = f"{self._counted[keys.LATE]} of {self.frames} frames were late"
            self._findings.warning("timing", keys.LATE, what, "bhd-data info lists them.")
        if self._counted[keys.SKIPPED]:
            self._findings.note("timing", keys.SKIPPED, f"{self._counted[keys.SKIPPED]} control ticks were skipped")

    # --- files -------------------------------------------------------------------------------------------------------

    def _read(self, name: str) -> pa.Table | None:
        stored = [
            key
            for key, feature in self._files.features.items()
            if feature.get("dtype") not in ("video", "image", "language")
        ]
        try:
            file = pq.ParquetFile(self._files.root / name, page_checksum_verification=True)
            missing = [key for key in stored if key not in file.schema_arrow.names]
            if missing:
                self._findings.error("schema", name, f"it has no column {brief(missing)}", _LEAVE)
                return None
            if wrong := wrong_columns(file.schema_arrow, self._files.features):
                self._findings.error("schema", name, wrong, _LEAVE)
                return None
            extra = [key for key in file.schema_arrow.names if key not in self._files.features]
            if extra:
                self._findings.warning(
                    "schema", name, f"meta/info.json knows no {brief(extra)}", "Programs leave it out."
                )
            return file.read(columns=list(dict.fromkeys((*stored, *DEFAULT_FEATURES))))
        except (OSError, pa.ArrowException, ValueError) as error:
            self._findings.error("files", name, f"it cannot be read: {one_line(error)}", RESTORE)
            return None

    def _in_order(self, name: str, table: pa.Table, rows: Sequence[Row]) -> pa.Table | None:
        """Return the frames in the order of their numbers; None if they are not those of these episodes."""
        order = check_numbers(self._files.root / name, table, rows, self._files.tasks, self._findings)
        if order is None:
            return None
        if (np.diff(order) < 0).any():
            table = table.take(order)
        self._check_times(name, table)
        return table

    def _check_times(self, name: str, table: pa.Table) -> None:
        frame, seconds = table["frame_index"].to_numpy(), table["timestamp"].to_numpy()
        due = frame / float(self._files.info["fps"])
        # Single precision cannot say it better after a while.
        wrong = np.flatnonzero(~(np.abs(seconds - due) <= np.maximum(_TIMESTAMP_TOLERANCE, 1e-6 * due)))
        if len(wrong):
            row = wrong[0]
            what = (
                f"{len(wrong)} timestamps are not frame_index / fps; the first in episode "
                f"{table['episode_index'][row]}, frame {frame[row]}: {seconds[row]:.6g} s"
            )
            self._findings.error("timing", name, what, "LeRobot refuses to load it; record it again.")

    # --- numbers -----------------------------------------------------------------------------------------------------

    def _check_table(self, table: pa.Table, rows: Sequence[Row]) -> None:
        self._longest = max(self._longest, *(row["length"] for row in rows))
        self.frames += len(table)
        for key in table.column_names:
            missing = table[key].null_count
            if missing:
                self._findings.error("finite", key, f"{missing} frames hold nothing", _LEAVE)
                continue
            values = numbers(table[key])
            if values is None:
                continue
            size = math.prod(self._files.features[key]["shape"])
            if values.size != len(table) * size:
                what = f"it holds {values.size} numbers in {len(table)} frames; its shape is {size}"
                self._findings.error("schema", key, what, "Repair the shape in meta/info.json, or record again.")
                continue
            self._check_column(key, values.reshape(len(table), size), rows)
        for key in (keys.LATE, keys.SKIPPED):
            if key in table.column_names and not table[key].null_count:
                self._counted[key] += int(table[key].to_numpy().sum())

    def _check_column(self, key: str, values: NDArray[Any], rows: Sequence[Row]) -> None:
        lengths, episodes = np.array([row["length"] for row in rows]), [row["episode_index"] for row in rows]
        starts = np.cumsum(lengths) - lengths
        with np.errstate(invalid="ignore"):  # the sum of both infinities
            found = Moments.of(values)
        if not (np.isfinite(found.low).all() and np.isfinite(found.high).all()):  # both of a column with a NaN are NaN
            self._note_broken(key, values, starts, episodes)
            values = np.where(np.isfinite(values), values, 0)
            found = Moments.of(values)
        known = self._columns.setdefault(key, found)
        if known is not found:
            known.add(found)
        if key in _MOVING:
            self._frozen.add(key, values, starts, lengths, episodes)
            self._steps.add(key, values, starts, episodes)

    def _note_broken(self, key: str, values: NDArray[Any], starts: NDArray[np.int64], episodes: Sequence[int]) -> None:
        rows, elements = np.nonzero(~np.isfinite(values))
        row, element = int(rows[0]), int(elements[0])
        episode = int(np.searchsorted(starts, row, side="right")) - 1
        frame, name = row - int(starts[episode]), name_of(self._files.features[key], element)
        where = f"episode {episodes[episode]}, frame {frame}: {name} is {values[row, element]}"
        self._broken.setdefault(key, []).append((len(np.unique(rows)), where))

    # --- over all files ----------------------------------------------------------------------------------------------

    def _judge_columns(self) -> None:
        for key, places in self._broken.items():
            count = sum(frames for frames, _ in places)
            what = f"{count} frames hold numbers that are not finite; the first in {places[0][1]}"
            if key.startswith(("observation", "action")):
                self._findings.error("finite", key, what, _LEAVE)
            else:
                self._findings.note("finite", key, what)
        for key, column in self._columns.items():
            for name, (low, high) in self._limits.get(key, {}).items():
                self._judge_limit(column, key, name, (low, high))

    def _judge_limit(self, column: Moments, key: str, name: str, limits: tuple[float, float]) -> None:
        names = keys.names_of(self._files.features[key])
        if name not in names:
            return
        (low, high), element = limits, names.index(name)
        found, room = (column.low[element], column.high[element]), _LIMIT_TOLERANCE * (high - low)
        if found[0] < low - room or found[1] > high + room:
            what = f"it goes from {found[0]:.4g} to {found[1]:.4g}; the robot's limits are {low:.4g} and {high:.4g}"
            self._findings.warning("limits", f"{key}: {name}", what, "Check the units and the robot type.")

    def _judge_stats(self) -> None:
        """Compare `meta/stats.json` with what was read."""
        if not self.frames or self.frames != self._files.info["total_frames"]:
            return
        remedy = stats_remedy(self._files)
        for key, column in self._columns.items():
            known = self._files.stats.get(key, {})
            if key in self._broken or not {"min", "max", "mean"} <= set(known):
                continue
            if len(self._files.features[key]["shape"]) > 1:
                continue  # LeRobot's are over other axes
            wrong = wrong_statistic(known, column, self._longest)
            if wrong is not None:
                where, what = f"{layout.STATS}: {key}", f"{wrong} is not that of the data"
                if key in UNREAD:
                    what += ", as after an edit by LeRobot; no policy reads it"
                    self._findings.warning("stats", where, what, remedy)
                else:
                    self._findings.error("stats", where, what, remedy)
            elif "std" in known and key.startswith(("observation", "action")):
                self._judge_deviation(key, column, known["std"], remedy)

    def _judge_deviation(self, key: str, column: Moments, stored: NDArray[np.float64], remedy: str) -> None:
        is_wrong, deviation = wrong_deviations(stored, column)
        if not is_wrong.any():
            return
        wrong = np.flatnonzero(is_wrong)
        is_zero = (stored[wrong] == 0).any()
        number = wrong[np.argmax(stored[wrong] == 0)] if is_zero else wrong[0]
        name = name_of(self._files.features[key], int(number))
        what = (
            f"the std of {brief(name_of(self._files.features[key], int(n)) for n in wrong)} is not that of the data: "
            f"of {name} it is {stored[number]:.3g}, and theirs is {deviation[number]:.3g}, as LeRobot rounds far from "
            "0; a policy that is normalised with it learns something else"
        )
        report = self._findings.error if is_zero else self._findings.warning
        report("stats", f"{layout.STATS}: {key}", what, remedy)
