"""What becomes of a bag: which topics are read for what, when an episode ends, and the dataset's names and units."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.ros2.messages.parts import Part


@dataclass(frozen=True)
class ImportOptions:
    """How bags are read, and what the dataset has.

    Attributes:
        robot_type: of the dataset.
        task: the instruction; None if exported bags have one for each episode.
        fps: frames a second.
        observation_names, action_names, environment_names: of the dataset's numbers, in order.
        lidar: the scanner that the dataset is of.
        topics: role (``scan``, ``odom``, ``cmd``, ``imu``) -> topic; only roles that are wanted.
        cameras: name of a camera -> topic.
        parts: role -> what carries numbers, of exported bags; the role begins with the feature and a slash.
        beams: that a scan has in the dataset.
        stamps: whose time counts: ``"auto"``, ``"header"`` or ``"receive"``.
        scan_frame, odom_frame: frames of the scanner and the base, if the user names them.
        scan_yaw: angle of the scanner in the robot [rad], if the user gives it.
        pose: whether the odometry's pose is wanted, beside its speeds.
        max_speed: largest of each action [m/s, rad/s], to which the applied action is limited; None if not known.
        max_age_s: age of the oldest reading beyond which a frame is late.
        max_gap_s: silence of a sensor that ends an episode.
        command_timeout_s: silence after which a command is no longer in force and the robot stands.
        timeouts: those that the user chooses from where the robot moves without a command; none if one was given.
        min_episode_s: shorter episodes are left out.
        outcome: what the episodes ended with; None if it is not known.
    """

    robot_type: str
    task: str | None
    fps: int
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    lidar: LidarSpec
    max_speed: tuple[float, ...] | None
    max_age_s: float
    max_gap_s: float
    command_timeout_s: float
    min_episode_s: float
    topics: Mapping[str, str] = field(default_factory=dict)
    cameras: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, Part] = field(default_factory=dict)
    environment_names: tuple[str, ...] = ()
    beams: int = 0
    stamps: str = "receive"
    scan_frame: str | None = None
    odom_frame: str | None = None
    scan_yaw: float | None = None
    pose: bool = False
    outcome: str | None = None
    timeouts: tuple[float, ...] = ()

    @property
    def topic_of(self) -> dict[str, str]:
        """All topics that are read, by role; a camera's is ``camera/<name>``."""
        cameras = {f"camera/{name}": topic for name, topic in self.cameras.items()}
        return {**self.topics, **{role: part.topic for role, part in self.parts.items()}, **cameras}

    def identity(self) -> dict[str, Any]:
        """Return what decides the episodes, JSON values. A recording has its simulation here, too."""
        plain = ("stamps", "scan_frame", "scan_yaw", "odom_frame", "max_age_s", "max_gap_s", "min_episode_s")
        timeout = None if np.isinf(self.command_timeout_s) else self.command_timeout_s
        values = {name: getattr(self, name) for name in plain}
        return {"imported": {"format": "rosbag2", "topics": self.topic_of, "command_timeout_s": timeout, **values}}
