"""Outcomes of episodes whose rows in ``meta/episodes`` are lost, and what is lost with these rows."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.assembly.assemble import EDITS, SORTED
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.state import Row
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.videos import FoundEpisode
from bhd_lerobot.datasets.validate.findings import Findings
from bhd_lerobot.errors import brief
from bhd_lerobot.tasks.task import OUTCOMES, Event

RECOVERED = "recovered"
"""Name of a salvage in ``meta/edits.jsonl``."""

_SHOWN = 30  # columns


def restore_outcomes(
    root: Path,
    recovered: Sequence[FoundEpisode],
    rows: Sequence[Row],
    stored: EpisodeRows,
    findings: Findings,
    *,
    is_ours: bool,
) -> None:
    """Write the outcomes of episodes without a row into their new rows, and report the columns that are lost.

    An outcome is a person's mark, or else the event of the last frame, where our recorder wrote it.

    Args:
        is_ours: whether our recorder wrote every episode, so that each had a row with columns of ours.
    """
    without_row = [(episode, row) for episode, row in zip(recovered, rows, strict=True) if not episode.has_row]
    marked, is_older = _marks(root)
    if not without_row or not (is_ours or stored.torn or marked or is_older):
        return
    names = {*stored.metadata_types, *stored.torn}
    known: list[int] = []
    for episode, row in without_row:
        outcome = marked.get(episode.number) or (_ended_with(episode) if is_ours or stored.torn else None)
        if outcome is not None:
            known.append(episode.number)
            row["bhd/outcome"] = outcome
            if "success" in names or "outcome" not in names:
                row["bhd/success"] = outcome == Event.SUCCESS.cause
    if known:
        stored.metadata_types.setdefault("outcome", pa.string())
        if any("bhd/success" in row for row in rows):
            stored.metadata_types.setdefault("success", pa.bool_())
        for row in rows:
            row |= {f"bhd/{name}": row.get(f"bhd/{name}") for name in stored.metadata_types}
        what = f"it or the event of the last frame gives the outcomes of {_episodes(known)}"
        findings.note("outcome", EDITS, what)
    numbers = [episode.number for episode, _ in without_row]
    others = sorted(set(numbers) - set(known))
    if is_ours or stored.torn:
        rest = sorted(f"bhd/{name}" for name in names - ({"outcome", "success"} if known else set()))
        columns = brief(rest, _SHOWN) if rest else "all columns bhd/… but outcome and success" if known else "all bhd/…"
        findings.error("outcome", "meta/episodes", f"{columns} of {_episodes(numbers)}")
        if known and others:
            findings.error("outcome", "meta/episodes", f"bhd/outcome, bhd/success of {_episodes(others)}")
    if is_older and others:
        what = "outcomes that were marked before episodes were renumbered; the file has them under the old numbers"
        findings.error("outcome", EDITS, what)


def logged(root: Path, recovered: Sequence[FoundEpisode], time: str) -> bytes:
    """Return the content of ``meta/edits.jsonl`` with the salvage as its last line."""
    path = root / EDITS
    before = path.read_bytes() if path.is_file() else b""
    edit = {"time": time, "edit": RECOVERED, "episodes": [episode.number for episode in recovered]}
    return before + (b"\n" if before and not before.endswith(b"\n") else b"") + json.dumps(edit).encode() + b"\n"


def _marks(root: Path) -> tuple[dict[int, str], bool]:
    """Return the marked outcomes, by the number of the episode now, and whether there are older ones."""
    outcomes: dict[int, str] = {}
    is_older = False
    path = root / EDITS
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            edit: dict[str, Any] = json.loads(line)
            if edit["edit"] == "mark":
                marks = {one["episode"]: one["outcome"][1] for one in edit["episodes"] if "outcome" in one}
                outcomes |= {number: outcome for number, outcome in marks.items() if outcome in OUTCOMES}
            elif edit["edit"] not in (RECOVERED, SORTED) or edit["episodes"] != list(range(len(edit["episodes"]))):
                is_older |= bool(outcomes)
                outcomes = {}
        except (ValueError, KeyError, TypeError, IndexError):
            # Whether this edit renumbered the episodes is not known.
            is_older |= bool(outcomes)
            outcomes = {}
    return outcomes, is_older


def _ended_with(episode: FoundEpisode) -> str | None:
    """Return the outcome of the last frame's event; None if the column is not one that `bhd-record` writes."""
    if keys.EVENT not in episode.table.column_names:
        return None
    *before, last = np.asarray(episode.table[keys.EVENT].to_pylist(), dtype=object).reshape(-1).tolist()
    if set(before) - {Event.NOTHING, Event.INTERVENTION}:
        return None
    return next((each.cause for each in Event if each == last and each.cause in OUTCOMES), None)


def _episodes(numbers: Sequence[int]) -> str:
    """Return numbers in order as text: a range where there is no hole."""
    if len(numbers) > 2 and list(numbers) == list(range(numbers[0], numbers[-1] + 1)):
        return f"episodes {numbers[0]} to {numbers[-1]}"
    return f"episode{'s' if len(numbers) > 1 else ''} {brief([str(number) for number in numbers], 8)}"
