"""Qualities of service that a recorder wrote of a topic: one for each publisher that there was."""

from typing import Any

import yaml


def offered(profiles: Any) -> int:
    """Return how many publishers offered a topic when the recorder subscribed; 0 if that is not said.

    Args:
        profiles: ``offered_qos_profiles``: a YAML text in versions 4 to 8 of rosbag2's metadata, in SQLite files and in
            the channels of MCAP files; a list in version 9. What is no such thing says nothing.
    """
    if isinstance(profiles, str):
        try:
            profiles = yaml.safe_load(profiles)
        except yaml.YAMLError:
            return 0
    return len(profiles) if isinstance(profiles, list) else 0
