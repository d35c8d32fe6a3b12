"""What a teleoperator or brain offers whose actions are absolute poses, reached from where the robot is."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from bhd_lerobot.bodies.body import Body


@runtime_checkable
class StartsFromObservation(Protocol):
    """A source of actions that has to know where the robot is.

    Observations are those of LeRobot's `Robot.get_observation`: numbers by feature name, SI units; images are not used.
    """

    def start_from(self, observation: Mapping[str, Any], body: Body | None = None) -> None:
        """Begin at the robot's present pose: at the start of an episode, and whenever a person takes over.

        Args:
            observation: the newest.
            body: the robot's hardware, if it is known.

        Raises:
            ConfigError: the observation lacks the pose.
        """

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Take the newest observation, before each action."""
