"""Outcomes and interventions that a person marks after the recording."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.assembly.picks import Pick
from bhd_lerobot.datasets.edit.edits import Change, EditReport, OnDone, check_episodes, rewrite
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import frames_of, to_numpy
from bhd_lerobot.datasets.format.state import DatasetState, Row, ordered_slots, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.layout import Slot
from bhd_lerobot.errors import ConfigError, DatasetError, unknown_name
from bhd_lerobot.tasks.task import OUTCOMES, Event, outcomes_of

_REASON = "marked afterwards"
_COLUMNS: Mapping[str, pa.DataType] = {"outcome": pa.string(), "success": pa.bool_()}


def mark(
    root: Path | str,
    episodes: Sequence[int],
    *,
    outcome: str | None = None,
    intervention: tuple[int, int] | None = None,
    clear_interventions: bool = False,
    note: str = "",
    on_done: OnDone = lambda _: None,
) -> EditReport:
    """Mark how episodes ended, or the frames of an intervention.

    The columns ``event`` and ``next.success``, ``bhd/outcome`` and ``bhd/success`` of the episodes, and the statistics
    follow; ``meta/edits.jsonl`` keeps the former values. A dataset that another program recorded gets
    ``bhd/outcome`` and ``bhd/success``, empty for episodes without a mark; its frames stay as they are. The score
    stays that of the task.

    Args:
        outcome: what they ended with, one of `OUTCOMES`; ``failure`` is a failure without a cause.
        intervention: first and last frame of an intervention.
    """
    if outcome is not None and outcome not in OUTCOMES:
        raise ConfigError(unknown_name("outcome", outcome, OUTCOMES))
    if outcome is None and intervention is None and not clear_interventions:
        raise ConfigError(f"Give a mark: an outcome ({', '.join(OUTCOMES)}), or frames of an intervention.")
    if not episodes:
        raise ConfigError("Give the episodes to mark.")
    request = {
        "edit": "mark",
        "episodes": list(episodes),
        **({"outcome": outcome} if outcome is not None else {}),
        **({"intervention": list(intervention)} if intervention is not None else {}),
        **({"clear_interventions": True} if clear_interventions else {}),
        **({"note": note} if note else {}),
    }

    def change(state: DatasetState) -> Change:
        check_episodes(state, episodes)
        for row in [state.rows[episode] for episode in episodes] if outcome is not None else []:
            if outcome not in (possible := possible_outcomes(state, row)):
                raise ConfigError(
                    f"Episode {row['episode_index']} of {state.root} cannot have ended with {outcome!r}: "
                    f"{_what(state, row)}. Valid: {', '.join(possible)}."
                )
        changes = _Changes(state, outcome, intervention, clear_interventions)
        meant = set(episodes)
        picks = [changes.pick(row) if row["episode_index"] in meant else Pick(state, row) for row in state.rows]
        edit = {"edit": "mark", "episodes": changes.log, **({"note": note} if note else {})}
        types = _COLUMNS if outcome is not None and "outcome" not in state.metadata_types else {}
        return Change(picks, edit, state.identity, types)

    return rewrite(Path(root), request, change, on_done)


def possible_outcomes(state: DatasetState, row: Row) -> tuple[str, ...]:
    """Return what an episode can have ended with, by its task and its robot; all outcomes if these are unknown."""
    return outcomes_of(_task_of(state, row), body_of(state.info.get("robot_type")))


def _task_of(state: DatasetState, row: Row) -> str | None:
    try:
        task = json.loads(row.get("bhd/task") or "null") or (state.identity or {})["recording"]["task"]
        return str(task["type"])
    except (ValueError, KeyError, TypeError):
        return None


def _what(state: DatasetState, row: Row) -> str:
    known = {"its robot is": state.info.get("robot_type"), "its task": _task_of(state, row)}
    return ", ".join(f"{what} {name}" for what, name in known.items() if name)


class _Changes:
    """Makes the picks of the marked episodes, and logs their former values."""

    def __init__(
        self, state: DatasetState, outcome: str | None, intervention: tuple[int, int] | None, clear: bool
    ) -> None:
        self.log: list[dict[str, Any]] = []
        self._state, self._outcome, self._intervention, self._clear = state, outcome, intervention, clear
        self._slots = ordered_slots(state.rows, "data")
        self._frames: dict[tuple[Slot, str], dict[int, pa.Table]] = {}
        self._features = state.info["features"]
        # The meaning of the columns of another program is unknown.
        self._has_events = state.identity is not None and keys.EVENT in self._features
        self._has_success = state.identity is not None and keys.SUCCESS in self._features
        if not self._has_events and (intervention is not None or clear):
            raise DatasetError(
                f"{state.root} has no column {keys.EVENT!r} of this program, so no frame can be marked. Its outcome "
                "can (--outcome)."
            )

    def pick(self, row: Row) -> Pick:
        length = row["length"]
        metadata: dict[str, Any] = {}
        columns: dict[str, np.ndarray] = {}
        entry: dict[str, Any] = {"episode": row["episode_index"]}
        if self._has_events:
            events = self._column(row, keys.EVENT)
            columns[keys.EVENT] = events
            entry |= self._intervene(events, row, metadata)
        if self._outcome is not None:
            entry["outcome"] = [row.get("bhd/outcome"), self._outcome]
            is_success = self._outcome == Event.SUCCESS.cause
            metadata["outcome"] = self._outcome
            if "success" in self._state.metadata_types or "outcome" not in self._state.metadata_types:
                metadata["success"] = is_success
            if self._has_events:
                columns[keys.EVENT][-1] = Event[self._outcome.upper()]
            if self._has_success:
                columns[keys.SUCCESS] = np.zeros(length, np.bool_)
                columns[keys.SUCCESS][-1] = is_success
        self.log.append(entry)
        return Pick(self._state, row, metadata, columns)

    def _intervene(self, events: np.ndarray, row: Row, metadata: dict[str, Any]) -> dict[str, Any]:
        """Change the events and the intervention metadata of an episode; return the log entry."""
        if not self._clear and self._intervention is None:
            return {}
        recorded = _interventions(row)
        driven = events == Event.INTERVENTION
        for first, end, _ in recorded:  # the last frame's event is what ended the episode, whoever drove
            driven[first:end] = True
        before = _spans(driven)
        if self._clear:
            driven[:] = False
        if self._intervention is not None:
            first, last = self._intervention
            if not 0 <= first <= last < row["length"]:
                raise ConfigError(
                    f"Frames {first} to {last} are not frames of episode {row['episode_index']}; valid: 0 to "
                    f"{row['length'] - 1}, the first not after the last."
                )
            driven[first : last + 1] = True
        events[(events == Event.INTERVENTION) & ~driven] = Event.NOTHING
        events[(events == Event.NOTHING) & driven] = Event.INTERVENTION
        if "interventions" in self._state.metadata_types:
            reasons = {first: why for first, _, why in recorded}
            spans = [[first, last + 1, reasons.get(first, _REASON)] for first, last in _spans(driven)]
            metadata["interventions"] = json.dumps(spans)
        if "intervened_frames" in self._state.metadata_types:
            metadata["intervened_frames"] = int(driven.sum())
        return {"interventions": [before, _spans(driven)]}

    def _column(self, row: Row, key: str) -> np.ndarray:
        slot = slot_of(row, "data")
        path = self._state.root / layout.data_file(slot)
        if (slot, key) not in self._frames:
            self._frames = {(slot, key): frames_of(path, self._slots[slot], [key])}  # of one file: its episodes follow
        return to_numpy(self._frames[slot, key][row["episode_index"]][key]).copy()


def _interventions(row: Row) -> list[tuple[int, int, str]]:
    """Return first frame, end and reason of each recorded intervention of an episode."""
    stored = row.get("bhd/interventions")
    try:
        found = [(first, end, str(why)) for first, end, why in json.loads(stored or "[]")]
    except (ValueError, TypeError, RecursionError):
        found = [(-1, 0, "")]
    if not all(isinstance(first, int) and isinstance(end, int) and 0 <= first <= end for first, end, _ in found):
        raise DatasetError(
            f"bhd/interventions of episode {row['episode_index']} is no list of first frame, end and reason: "
            f"{stored!r:.200}. Restore meta/episodes from a copy. Nothing was changed."
        )
    return found


def _spans(flags: np.ndarray) -> list[list[int]]:
    """Return the first and the last frame of every run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [[int(first), int(end) - 1] for first, end in edges.reshape(-1, 2)]
