"""When the loop of the cerebellum stops the robot by itself."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LoopLimits:
    """When the loop stops the robot by itself.

    Attributes:
        brain_timeout_s: after so long without a sign of life of the brain's process a robot that moves decelerates and
            holds [s].
        plant_timeout_s: a reading of a plant that is older than this is a FAULT [s]; at least three ticks.
        most_misses: after so many starts in a row that came a period or more too late, FAULT.
        most_catch_up: so many periods at the most are caught up by one tick; what is beyond is lost to the simulation,
            which then is behind, and counted.
    """

    brain_timeout_s: float = 0.5
    plant_timeout_s: float = 0.02
    most_misses: int = 10
    most_catch_up: int = 10
