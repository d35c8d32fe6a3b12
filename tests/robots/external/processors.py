"""Functions between a teleoperator and a robot."""

from typing import Any


def halved(action: dict[str, Any], observation: dict[str, Any]) -> dict[str, float]:
    """Return half of the action; the observation is there, by name."""
    assert "elbow.pos" in observation
    return {name: value / 2 for name, value in action.items()}
