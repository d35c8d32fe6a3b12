"""Names with points in them, such as `x.vel`, as keys of an option."""

from typing import Any


def flattened(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return values by their full names: a command line makes ``{"x": {"vel": 1}}`` of ``x.vel``.

    A dictionary with the key ``from`` is a value.
    """
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict) and "from" not in value:
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
