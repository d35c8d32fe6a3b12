"""What only ``meta/episodes`` told of episodes whose rows are gone: their outcomes follow, the rest is named."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.state import Row
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.videos import Found
from bhd_lerobot.datasets.validate.findings import few
from bhd_lerobot.tasks.task import OUTCOMES, Event

RECOVERED = "recovered"
"""Name of a salvage in ``meta/edits.jsonl``."""

_SHOWN = 30  # columns


def recall(
    root: Path, kept: Sequence[Found], rows: Sequence[Row], told: EpisodeRows, *, is_ours: bool
) -> tuple[list[str], list[str]]:
    """Write the outcomes of episodes without a row into their new rows, and name what cannot be told again.

    An outcome is what somebody said afterwards, or else the event of the last frame, where our recorder wrote it.

    Args:
        root: the corrupted dataset.
        kept: episodes that were recovered.
        rows: their new rows; changed in place.
        told: what could be read of the old ones; its types get those of the outcomes.
        is_ours: whether our recorder wrote every episode, so that each had a row with columns of ours.

    Returns:
        What is lost, and what is known from elsewhere, in lines.
    """
    without_row = [(one, row) for one, row in zip(kept, rows, strict=True) if not one.has_row]
    marked, is_older = _marks(root)
    if not without_row or not (is_ours or told.torn or marked or is_older):
        return [], []
    names = {*told.metadata_types, *told.torn}
    known: list[int] = []
    for one, row in without_row:
        outcome = marked.get(one.number) or (_ended_with(one) if is_ours or told.torn else None)
        if outcome is not None:
            known.append(one.number)
            row["bhd/outcome"] = outcome
            if "success" in names or "outcome" not in names:
                row["bhd/success"] = outcome == Event.SUCCESS.cause
    if known:
        told.metadata_types.setdefault("outcome", pa.string())
        if any("bhd/success" in row for row in rows):
            told.metadata_types.setdefault("success", pa.bool_())
        for row in rows:
            row |= {f"bhd/{name}": row.get(f"bhd/{name}") for name in told.metadata_types}
    numbers = [one.number for one, _ in without_row]
    lost = _lost(numbers, known, names, is_ours=is_ours or bool(told.torn))
    if is_older and set(numbers) - set(known):
        lost.append(
            f"{EDITS}: outcomes that were marked before episodes were numbered anew. The file still tells them, under "
            "the numbers of that time"
        )
    said = [f"the outcomes of {_episodes(known)} are told by {EDITS} or by their last frames"] if known else []
    return lost, said


def _lost(numbers: list[int], known: list[int], names: set[str], *, is_ours: bool) -> list[str]:
    if not is_ours:
        return []
    rest = sorted(f"bhd/{name}" for name in names - ({"outcome", "success"} if known else set()))
    columns = few(rest, _SHOWN) if rest else "all columns bhd/… but outcome and success" if known else "all bhd/…"
    lines = [f"meta/episodes: {columns} of {_episodes(numbers)}"]
    if known and (others := sorted(set(numbers) - set(known))):
        lines.append(f"meta/episodes: bhd/outcome, bhd/success of {_episodes(others)}")
    return lines


def logged(root: Path, kept: Sequence[Found], time: str) -> bytes:
    """Return the content of ``meta/edits.jsonl`` with the salvage as its last line."""
    path = root / EDITS
    before = path.read_bytes() if path.is_file() else b""
    edit = {"time": time, "edit": RECOVERED, "episodes": [one.number for one in kept]}
    return before + (b"\n" if before and not before.endswith(b"\n") else b"") + json.dumps(edit).encode() + b"\n"


def _marks(root: Path) -> tuple[dict[int, str], bool]:
    """Return the outcomes that somebody marked, by the number of the episode now, and whether there are older ones."""
    outcomes: dict[int, str] = {}
    is_older = False
    path = root / EDITS
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            edit: dict[str, Any] = json.loads(line)
            if edit["edit"] == "mark":
                told = {one["episode"]: one["outcome"][1] for one in edit["episodes"] if "outcome" in one}
                outcomes |= {number: outcome for number, outcome in told.items() if outcome in OUTCOMES}
            elif edit["edit"] != RECOVERED or edit["episodes"] != list(range(len(edit["episodes"]))):
                is_older |= bool(outcomes)
                outcomes = {}
        except (ValueError, KeyError, TypeError, IndexError):
            # Whether it numbered the episodes anew is not known.
            is_older |= bool(outcomes)
            outcomes = {}
    return outcomes, is_older


def _ended_with(one: Found) -> str | None:
    """Return the outcome that the last frame's event tells; None if the column is not what `bhd-record` writes."""
    if keys.EVENT not in one.table.column_names:
        return None
    *before, last = np.asarray(one.table[keys.EVENT].to_pylist(), dtype=object).reshape(-1).tolist()
    if set(before) - {Event.NOTHING, Event.INTERVENTION}:
        return None
    return next((each.cause for each in Event if each == last and each.cause in OUTCOMES), None)


def _episodes(numbers: Sequence[int]) -> str:
    """Return numbers in order in words: a range where there is no hole."""
    if len(numbers) > 2 and list(numbers) == list(range(numbers[0], numbers[-1] + 1)):
        return f"episodes {numbers[0]} to {numbers[-1]}"
    return f"episode{'s' if len(numbers) > 1 else ''} {few([str(number) for number in numbers], 8)}"
