"""What the page's marks do to the dataset, and what was marked before."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.assembly.assemble import edit_lines
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.errors import ConfigError, DatasetError

_FIELDS = {"outcome": str, "intervention": list, "clear_interventions": bool, "note": str}


def mark_episode(root: Path, index: int, wanted: Any) -> None:
    """Mark an episode as the page wants it.

    Args:
        wanted: any of ``outcome``, a name; ``intervention``, first and last frame; ``clear_interventions``, true or
            false; ``note``, text. Else a `ConfigError` is raised.
    """
    if not isinstance(wanted, Mapping):
        raise ConfigError(f"A mark is an object with some of {', '.join(_FIELDS)}; got {wanted!r}.")
    for name, value in wanted.items():
        if name not in _FIELDS or not isinstance(value, _FIELDS[name]):
            raise ConfigError(f"{name}={value!r} is no mark; valid: {', '.join(_FIELDS)}.")
    span = wanted.get("intervention")
    if span is not None and not (len(span) == 2 and all(type(frame) is int for frame in span)):
        raise ConfigError(f"intervention is {span!r}; it must be the first and the last frame.")
    mark(
        root,
        [index],
        outcome=wanted.get("outcome"),
        intervention=None if span is None else (span[0], span[1]),
        clear_interventions=wanted.get("clear_interventions", False),
        note=wanted.get("note", ""),
    )


def marks_of(root: Path, index: int) -> list[dict[str, Any]]:
    """Return what was marked of an episode, oldest first, since episodes have had the numbers that they have now."""
    try:
        lines = edit_lines(root)
    except DatasetError:
        return []
    found: list[dict[str, Any]] = []
    for line in lines:
        try:
            edit = json.loads(line)
            if edit["edit"] != "mark":
                found.clear()  # episodes were removed or joined: the numbers before mean something else
                continue
            marks = [entry for entry in edit["episodes"] if entry["episode"] == index]
        except (ValueError, KeyError, TypeError):
            continue  # the log is for people; a line that is not of ours says nothing here
        found += [{**entry, "when": edit.get("time", ""), "note": edit.get("note", "")} for entry in marks]
    return found
