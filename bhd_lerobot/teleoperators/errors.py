"""What a teleoperator raises for a person at the command line."""

from bhd_lerobot.errors import ConfigError


class TeleoperatorConfigError(ConfigError, SystemExit):
    """The teleoperator cannot drive the robot that there is, or has no input.

    LeRobot's commands catch nothing: as a `SystemExit` it ends them with its message, without a traceback.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.code = message
