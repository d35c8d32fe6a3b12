"""How punctual the frames of a dataset are, as it was stored with its episodes."""

import json
from dataclasses import asdict, replace
from typing import Any

from bhd_lerobot.datasets.format.summary import EpisodeSummary
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.realtime.timing import TimingSummary

_GRANT = {"name", "wanted", "granted", "detail", "remedy"}
_MOST = 1e18  # of counts and seconds: beyond it is no measurement
CLOCKS = ("lockstep", "realtime")


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


def grants_of(episode: EpisodeSummary) -> list[dict[str, Any]]:
    """Return what the control loop asked the operating system for: `name`, `wanted`, `granted`, `detail`, `remedy`."""
    if not episode.metadata.get("realtime"):
        return []
    grants = _stored(episode, "realtime")
    if not isinstance(grants, list) or not all(isinstance(grant, dict) and grant.keys() >= _GRANT for grant in grants):
        raise DatasetError(f"bhd/realtime of episode {episode.index} is no list of grants: {grants!r:.200}.")
    return grants


def _stored(episode: EpisodeSummary, name: str) -> Any:
    try:
        return json.loads(episode.metadata[name])
    except (TypeError, ValueError, RecursionError) as error:
        text = episode.metadata[name]
        raise DatasetError(f"bhd/{name} of episode {episode.index} is not JSON: {text!r:.200} ({error}).") from error


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MOST


def ms(seconds: float) -> str:
    """Return a time in milliseconds with three digits that mean something."""
    value = 1e3 * float(seconds)
    return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:.1f}" if abs(value) >= 9.995 else f"{value:.2f}"
