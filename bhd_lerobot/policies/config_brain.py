"""The registry of brain configurations; `type` in a configuration file names one."""

from typing import TYPE_CHECKING, Any, ClassVar

import draccus


class BrainConfig(draccus.ChoiceRegistry):
    """Base class of brain configurations.

    Attributes:
        is_composed: whether its options hold other brains.
    """

    is_composed: ClassVar[bool] = False


if TYPE_CHECKING:
    DriverConfig = BrainConfig
else:

    class DriverConfig(draccus.ChoiceRegistry):
        """The configurations of brains that are not made of others, for options of those that are.

        LeRobot's command lines list the options of every choice, and those of the choices in them: a brain that may
        hold every brain would hold itself, without an end.
        """

        @classmethod
        def get_known_choices(cls) -> dict[str, Any]:
            """Return the brains that are not made of others, by their names."""
            known = BrainConfig.get_known_choices()
            return {name: choice for name, choice in known.items() if not choice.is_composed}

        @classmethod
        def get_choice_class(cls, name: str) -> Any:
            """Return the configuration of the brain with this name."""
            return cls.get_known_choices()[name]

        @classmethod
        def get_choice_name(cls, subcls: type) -> str:
            """Return the name of the brain that a configuration is of."""
            return BrainConfig.get_choice_name(subcls)
