"""Options of robots and teleoperators of other packages that say what their numbers mean."""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from bhd_lerobot.options.dotted import flattened

_UNITS = re.compile("degree|radian|unit|norm|scal", re.IGNORECASE)
_MEANING = re.compile(f"{_UNITS.pattern}|invert|sign|offset|zero|homing|ratio|gear|direction|mirror|mode|order", re.I)


def other_units(
    recorded: Mapping[str, Any], present: Mapping[str, Any], *, units_only: bool = False
) -> Iterator[tuple[str, str, str]]:
    """Yield name and both values of each option that gives the numbers of two devices another meaning.

    What only one of them has is not compared, nor robots of this package, whose numbers are in SI units.
    """
    if "clock" in recorded or "clock" in present:
        return
    here, pattern = flattened(dict(present)), _UNITS if units_only else _MEANING
    for name, value in flattened(dict(recorded)).items():
        then, now = json.dumps(value), json.dumps(here.get(name))
        if name in here and then != now and pattern.search(name) and "cameras" not in name.split("."):
            yield name, then, now
