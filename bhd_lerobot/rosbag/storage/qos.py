"""Qualities of service that a recorder wrote of a topic: one for each publisher that there was."""

from functools import lru_cache
from typing import Any

import yaml


def offered(profiles: Any) -> int:
    """Return how many publishers offered a topic when the recorder subscribed; 0 if that is not said.

    Args:
        profiles: ``offered_qos_profiles``: a YAML text in versions 4 to 8 of rosbag2's metadata, in SQLite files and in
            the channels of MCAP files; a list in version 9. What is no such thing says nothing.
    """
    if isinstance(profiles, str):
        return _listed(profiles)
    return len(profiles) if isinstance(profiles, list) else 0


@lru_cache(maxsize=256)  # a bag has few that differ, and YAML is slow
def _listed(text: str) -> int:
    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return 0
    return len(profiles) if isinstance(profiles, list) else 0
