"""Configuration of the brain `teleop`."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive, some_of
from bhd_lerobot.policies.brain import BrainConfig

if TYPE_CHECKING:
    from lerobot.teleoperators.config import TeleoperatorConfig as PersonConfig
else:
    # Not `bhd_brain`, which holds a brain.
    PersonConfig = some_of(TeleoperatorConfig, lambda choice: choice.__name__ != "BhdBrainConfig")
    """The configurations of teleoperators that a person holds."""


@BrainConfig.register_subclass("teleop")
@dataclass
class TeleopConfig(BrainConfig):
    """A person drives, through a teleoperator of LeRobot or of a plug-in.

    Attributes:
        teleop: the teleoperator, with its own options.
        map: where actions come from, by their names, if the teleoperator calls them otherwise or has other units:
            `--map.x.vel='{from: linear_velocity, scale: 0.22}'`, or only a name. `scale` is a number, or
            `deg_to_rad` or `rad_to_deg`; `offset` is added afterwards.
        processor: a function `(action, observation) -> action` of dictionaries that stands between teleoperator and
            robot, as `package.module:name`.
        timeout_s: a teleoperator that has not answered for so long ends the episode with a fault [s].
    """

    is_composed: ClassVar[bool] = True

    teleop: PersonConfig
    map: dict[str, Any] = field(default_factory=dict)
    processor: str = ""
    timeout_s: Positive = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.map and self.processor:
            raise ConfigError(
                "map and processor are both set, and both give the robot's actions: leave one of them out; a processor "
                "can translate names and units, too."
            )
        module, sign, name = self.processor.partition(":")
        if self.processor and not (sign and module and name):
            raise ConfigError(f"brain.processor is {self.processor!r}; name a function as package.module:name.")
