"""What the configurations of both keyboard teleoperators have in common."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.errors import check_positive


@dataclass(kw_only=True)
class KeyboardConfig(TeleoperatorConfig):
    """Options of a teleoperator whose keys come from the terminal: the recorder's marks are then not on letters.

    Attributes:
        hold_s: time that a key is followed after it was sent [s]. A terminal sends a key again while it is held, for
            the first time after about 0.5 s, and does not report its release.
    """

    hold_s: float = 0.6

    def __post_init__(self) -> None:
        check_positive("teleop", self, ("hold_s",))
