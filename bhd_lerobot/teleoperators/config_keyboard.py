"""What the configurations of both keyboard teleoperators have in common."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.options.declared import Options, Positive


@dataclass(kw_only=True)
class KeyboardConfig(Options, TeleoperatorConfig, prefix="teleop."):
    """Options of a teleoperator whose keys come from the terminal: the recorder's marks are then not on letters.

    Attributes:
        hold_s: time that a key is followed after it was sent [s]. A terminal sends a key again while it is held, for
            the first time after about 0.5 s, and does not report its release.
    """

    hold_s: Positive = 0.6
