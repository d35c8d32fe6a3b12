"""What our teleoperators have in common: nothing to calibrate or to configure, and no feedback."""

from typing import Any

from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import ConfigError


class TeleoperatorConfigError(ConfigError, SystemExit):
    """The teleoperator cannot drive the robot that there is, or has no input.

    LeRobot's commands catch nothing: as a `SystemExit` it ends them with its message, without a traceback.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.code = message


class PlainTeleoperator(Teleoperator):
    """A teleoperator that takes no feedback, and that has nothing to calibrate or to configure."""

    feedback_features: dict[str, type] = {}  # noqa: RUF012  LeRobot's own form
    is_calibrated = True

    def check_new(self) -> None:
        """Check that it is not connected yet."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")

    def check_connected(self) -> None:
        """Check that `connect` was called."""
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected. Call connect() first.")

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""
