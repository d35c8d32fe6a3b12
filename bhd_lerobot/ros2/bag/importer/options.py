"""What becomes of a bag: which topics are read for what, when an episode ends, and the dataset's names and units."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bhd_lerobot.ros2.bag.importer.sources import Source


@dataclass(frozen=True)
class ImportOptions:
    """How bags are read, and what the dataset has.

    Attributes:
        stamps: whose time counts: ``"auto"``, ``"header"`` or ``"receive"``.
        pose: whether ``x.pos``, ``y.pos`` and ``theta.pos`` are those since the episode's start.
        max_speed: largest of each action [m/s, rad/s], to which the applied action is limited; None if not known.
        max_age_s: age of the oldest reading beyond which a frame is late.
        max_gap_s: silence of a sensor that ends an episode.
        command_timeout_s: silence after which a command is no longer in force and the robot stands.
        timeouts: those that the user chooses from where the robot moves without a command; none if one was given.
        min_episode_s: shorter episodes are left out.
        as_stated: whether the frames of an exported bag are those that it states. Otherwise it is resampled.
        robot_is_stated: whether robot and mapping are those that the first bag states.
        given: what else decides the episodes, JSON values.
    """

    robot_type: str
    task: str
    fps: int
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    sources: tuple[Source, ...]
    max_speed: tuple[float, ...] | None
    max_age_s: float
    max_gap_s: float
    command_timeout_s: float
    min_episode_s: float
    stamps: str = "receive"
    pose: bool = False
    outcome: str | None = None
    as_stated: bool = True
    robot_is_stated: bool = False
    timeouts: tuple[float, ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)

    def identity(self) -> dict[str, Any]:
        """Return what decides the episodes, JSON values. A recording has its simulation here, too."""
        plain = ("stamps", "max_age_s", "max_gap_s", "min_episode_s")
        values = {name: getattr(self, name) for name in plain} | dict(self.given)
        timeout = None if np.isinf(self.command_timeout_s) else self.command_timeout_s
        topics = {f"{source.feature}{source.topic}": source.topic for source in self.sources}
        return {"imported": {"format": "rosbag2", "topics": topics, "command_timeout_s": timeout, **values}}
