"""The identity of a recording, which decides whether it can be continued."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bhd_lerobot.errors import ConfigError, DatasetMismatchError

if TYPE_CHECKING:  # configurations import this module, and have no need of Arrow
    from bhd_lerobot.datasets.format.schema import Schema
    from bhd_lerobot.datasets.format.state import DatasetState

FORMAT = 1
"""Version of ``meta/bhd.json``."""
_MISSING: Any = object()


def as_json(recording: Mapping[str, Any]) -> dict[str, Any]:
    """Return `recording` as it will read after a trip through JSON."""
    try:
        return json.loads(json.dumps(dict(recording)))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"The description of the recording must consist of JSON values: {error}.") from error


def check_identity(
    state: "DatasetState",
    *,
    schema: "Schema",
    fps: int,
    robot_type: str,
    recording: Mapping[str, Any] | None,
    video: Mapping[str, Any] | None,
) -> None:
    """Check that a dataset may be continued with these; None accepts the recording and video that were recorded."""
    if state.identity is None:
        raise DatasetMismatchError(
            f"{state.root} was not recorded by this program (it has no meta/bhd.json). Record into another root."
        )
    if state.identity.get("format") != FORMAT:
        raise DatasetMismatchError(
            f"{state.root} was recorded with version {state.identity.get('format')} of this recorder's format; this "
            f"program continues version {FORMAT}. Record into another root."
        )
    if edit := (state.identity.get("recording") or {}).get("edited"):
        name = edit.get("edit", "edit") if isinstance(edit, Mapping) else "edit"
        raise DatasetMismatchError(
            f"{state.root} was edited after its recording ({name}), so it cannot be continued: its next episode would "
            "not be the one of its seed. Record the missing episodes into another root, with another seed, and merge "
            "the two."
        )
    recorded: dict[str, Any] = {"robot_type": state.info.get("robot_type"), "fps": state.info["fps"]}
    requested: dict[str, Any] = {"robot_type": robot_type, "fps": fps}
    recorded["features"] = comparable(state.info["features"])
    requested["features"] = comparable(schema.features)
    if recording is not None:
        recorded["recording"] = state.identity["recording"]
        requested["recording"] = as_json(recording)
    if video is not None:
        recorded["video"], requested["video"] = state.identity["video"], as_json(video)
    found = list(differences("", recorded, requested))
    if not found and list(recorded["features"]) != list(requested["features"]):
        old, new = list(recorded["features"]), list(requested["features"])
        found = [f"order of features: recorded {old}, requested {new}"]
    if found:
        text = "\n  ".join(found)
        raise DatasetMismatchError(
            f"{state.root} cannot be resumed, because it was recorded differently:\n  {text}\n"
            "Use the recorded values, or record into another root."
        )


def comparable(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the features without what the encoder added later."""
    return {key: {k: v for k, v in as_json(feature).items() if k != "info"} for key, feature in features.items()}


def differences(prefix: str, recorded: Any, requested: Any) -> Iterator[str]:
    """Yield a line for every value below `prefix` that is not the same in both."""
    for name, one, other in _unequal(prefix, recorded, requested):
        was, wanted = (
            f"not {what}" if value is _MISSING else f"{what} {as_text(value)}"
            for what, value in (("recorded", one), ("requested", other))
        )
        yield f"{name}: {was}, {wanted}"


def conflicts(prefix: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name and both values of what two descriptions state differently; what only one states is none."""
    return ((name, *both) for name, *both in _unequal(prefix, one, other) if _MISSING not in both)


def _unequal(prefix: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            name = f"{prefix}.{key}" if prefix else str(key)
            yield from _unequal(name, one.get(key, _MISSING), other.get(key, _MISSING))
    elif one != other:
        yield prefix, one, other


def as_text(value: Any) -> str:
    """Return a value of a description as a short text."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 120 else f"{text[:80]} ... ({len(text)} characters)"


def local_name(root: str | Path | None) -> str:
    """Return the `repo_id` of a dataset that was given a folder and no name: ``local/`` and the folder's name."""
    if not root:
        raise ConfigError("Neither dataset.root nor dataset.repo_id is given: name a folder, or user/name on the Hub.")
    name = re.sub(r"[^\w.-]", "_", Path(root).expanduser().resolve().name).strip("-.") or "dataset"
    return f"local/{name}"


def default_root(repo_id: str) -> Path:
    """Return where LeRobot looks for a dataset when no root is given."""
    import os

    from huggingface_hub.constants import HF_HOME

    return Path(os.environ.get("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")).expanduser() / repo_id
