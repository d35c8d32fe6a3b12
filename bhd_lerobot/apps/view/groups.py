"""Which numbers of an episode are drawn together: those that are of one kind and have one unit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.format import columns
from bhd_lerobot.datasets.format import features as keys

MAX_LINES = 8  # in one plot; more cannot be distinguished
_SCAN = re.compile(r"scan_\d+\.pos")
_METRES = ("x", "y", "z", "gripper", "tool_x", "tool_y", "tool_z")
_DELAYS = {keys.LATENESS: "lateness", keys.INFERENCE_TIME: "inference"}
_AGES = {keys.AGE: "observation", keys.COMMAND_AGE: "command"}
_COUNTS = {keys.SKIPPED: "skipped", keys.OVERRUNS: "overruns"}
_PLACED = (  # what has a place of its own on the page
    *(keys.TIME, keys.LATE, keys.LIMITS, keys.WATCHDOG, keys.MODE, keys.EVENT, keys.SUCCESS, keys.DONE),
    *(keys.ACTION, keys.APPLIED_ACTION, keys.OBSERVATION_STATE, keys.ENVIRONMENT_STATE, keys.REWARD),
    *(keys.EFFORT, keys.WRENCH, keys.PHYSICS_STATE),
)


def numbers(column: pa.ChunkedArray, frames: int) -> NDArray | None:
    """Return a column of numbers, of shape (frames, numbers); None if it holds something else."""
    values = columns.numbers(column)
    if values is None:
        return None
    if values.dtype == object:  # a column with gaps
        values = values.astype(np.float64)
    if frames == 0 or values.size % frames:
        return None
    return values.reshape(frames, -1)


def scan_of(names: Sequence[str]) -> tuple[int, int] | None:
    """Return the first number and the count of the beams of a laser scan; None if there is none."""
    beams = [number for number, name in enumerate(names) if _SCAN.fullmatch(name)]
    if len(beams) < 3 or beams != list(range(beams[0], beams[0] + len(beams))):
        return None
    return beams[0], len(beams)


def names_of(feature: Mapping[str, Any], width: int) -> list[str]:
    """Return the names of a feature's numbers, of which there are `width`, flat; what has none is numbered."""
    return list(keys.names_of({**feature, "shape": (width,)})) or [str(number) for number in range(width)]


def unit_of(name: str, robot: str | None) -> str:
    """Return the unit of a robot's number, of which only those of simulated robots are known; else nothing."""
    stem, _, kind = name.rpartition(".")
    if body_of(robot) is None or kind not in ("pos", "vel", "effort") or stem.startswith("tool_q"):
        return ""
    if kind == "effort":
        return "N" if stem in _METRES else "N m"
    length = stem in _METRES or stem.startswith("scan_")
    return ("m" if length else "rad") + ("/s" if kind == "vel" else "")


def sections(features: Mapping[str, Any], widths: Mapping[str, int], robot: str | None) -> list[dict[str, Any]]:
    """Return what is plotted: sections with a title, each a list of plots, each a list of lines.

    A line has a label and the number of its column; ``applied`` marks the command that was carried out beside the
    requested one.
    """
    result = []

    def add(title: str, plots: list[dict[str, Any]], *, is_open: bool, kind: str = "") -> None:
        if plots:
            result.append({"title": title, "open": is_open, "kind": kind, "plots": plots})

    def names(key: str) -> list[str]:
        return names_of(features[key], widths[key])

    if keys.ACTION in widths:
        add("Action", _actions(names(keys.ACTION), keys.APPLIED_ACTION in widths, robot), is_open=True, kind="action")
    if keys.OBSERVATION_STATE in widths:
        add("State", list(_by_kind(keys.OBSERVATION_STATE, names(keys.OBSERVATION_STATE), robot)), is_open=True)
    if keys.EFFORT in widths:
        add("Effort", list(_by_kind(keys.EFFORT, names(keys.EFFORT), robot)), is_open=False)
    if keys.WRENCH in widths:
        lines = [_line(keys.WRENCH, number, name) for number, name in enumerate(names(keys.WRENCH))]
        add("Force on the tool", [_plot("force", "N", lines[:3]), _plot("moment", "N m", lines[3:])], is_open=False)
    add("Timing", list(_timing(widths)), is_open=True, kind="timing")
    if keys.REWARD in widths:
        add("Reward", [_plot("reward", "", [_line(keys.REWARD, 0, "reward")])], is_open=False)
    privileged = (keys.ENVIRONMENT_STATE, "Environment state (privileged)"), (keys.PHYSICS_STATE, "Simulator state")
    for key, title in privileged:
        if key in widths:
            add(title, list(_chunks(key, names(key), "")), is_open=False)
    for key in widths:
        if key not in (*_PLACED, *_DELAYS, *_AGES, *_COUNTS):
            add(key, list(_chunks(key, names(key), "")), is_open=False)
    return result


def _actions(names: Sequence[str], has_applied: bool, robot: str | None) -> list[dict[str, Any]]:
    plots = []
    for number, name in enumerate(names):
        lines = [_line(keys.ACTION, number, "requested" if has_applied else name)]
        if has_applied:
            lines.append({**_line(keys.APPLIED_ACTION, number, "applied"), "applied": True})
        plots.append(_plot(name, unit_of(name, robot), lines))
    return plots


def _by_kind(key: str, names: Sequence[str], robot: str | None) -> Iterator[dict[str, Any]]:
    scan = scan_of(names)
    beams = range(scan[0], sum(scan)) if scan else range(0)
    groups: dict[tuple[str, str], list[int]] = {}
    for number, name in enumerate(names):
        if number not in beams:
            kind = name.rpartition(".")[2] if "." in name else ""
            groups.setdefault((kind, unit_of(name, robot)), []).append(number)
    words = {"pos": "positions", "vel": "speeds", "effort": "efforts"}
    for (kind, unit), numbers in groups.items():
        title = words.get(kind, kind or key.rpartition(".")[2])
        yield from _chunks(key, names, title, numbers, unit, suffix=f".{kind}" if kind else "")


def _chunks(
    key: str,
    names: Sequence[str],
    title: str,
    numbers: Sequence[int] | None = None,
    unit: str = "",
    *,
    suffix: str = "",
) -> Iterator[dict[str, Any]]:
    """Yield plots of at most `MAX_LINES` lines, about equally many in each."""
    numbers = range(len(names)) if numbers is None else numbers
    count = -(-len(numbers) // MAX_LINES)
    for part in range(count):
        chosen = numbers[part * len(numbers) // count : (part + 1) * len(numbers) // count]
        lines = [_line(key, number, names[number].removesuffix(suffix) or names[number]) for number in chosen]
        named = title or (lines[0]["label"] if len(lines) == 1 else f"{lines[0]['label']} … {lines[-1]['label']}")
        yield _plot(f"{named} ({part + 1} of {count})" if title and count > 1 else named, unit, lines)


def _timing(widths: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    for title, labels in (("lateness and inference", _DELAYS), ("age", _AGES)):
        times = [{**_line(key, 0, label), "scale": 1000.0} for key, label in labels.items() if key in widths]
        if times:
            yield _plot(title, "ms", times)
    counts = [_line(key, 0, label) for key, label in _COUNTS.items() if key in widths]
    if counts:
        yield _plot("control ticks", "", counts)


def _plot(title: str, unit: str, lines: list[dict[str, Any]]) -> dict[str, Any]:
    return {"title": title, "unit": unit, "lines": lines}


def _line(key: str, number: int, label: str) -> dict[str, Any]:
    return {"column": key, "number": number, "label": label}
