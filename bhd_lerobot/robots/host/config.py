"""Options of a robot on the wall clock."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, Options, Positive
from bhd_lerobot.realtime.limits import LoopLimits
from bhd_lerobot.realtime.privileges import RealtimeSettings

CLOCKS = ("lockstep", "realtime")


@dataclass(kw_only=True)
class RealtimeConfig(Options, prefix="robot.realtime."):
    """How a robot runs with ``clock = "realtime"``; without effect on the lockstep clock.

    Attributes:
        priority: priority of the real-time process under SCHED_FIFO, 1 to 99.
        lock_memory: keep all of its memory in RAM.
        hold_cpu_latency: keep the processors from sleeping deeply meanwhile.
        freeze_collector: run it without Python's garbage collector.
        affinity: the processors that it may run on; all if empty.
        brain_timeout_s: after so long without a sign of life of the brain's process the robot decelerates and holds
            [s]; if not set 0.5 s, with `plant = "ros2"` `ros2.timeout_s`.
        most_misses: after so many ticks in a row that came a period or more too late the robot stops, with FAULT.
        most_catch_up: so many missed ticks at the most are caught up at once by the simulation.
        plant_timeout_s: with `robot.plant`, a reading that is older than this, and than three control ticks, is a
            FAULT [s].
        buffer_s: the states of so long are kept in shared memory: by so much may what records them, or watches, fall
            behind before one is lost, and counted [s].
    """

    removed: ClassVar[dict[str, str]] = {
        "plant_process": "a simulated world ticks in the cerebellum's process, and ends with it",
        "recorder_timeout_s": "there is no recorder's process to wait for, frames are read by the brain's process",
    }

    priority: int = 80
    lock_memory: bool = True
    hold_cpu_latency: bool = True
    freeze_collector: bool = True
    affinity: list[int] = field(default_factory=list)
    brain_timeout_s: Positive | None = None
    most_misses: Count = 10
    most_catch_up: Count = 10
    plant_timeout_s: Positive = 0.02
    buffer_s: Positive = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.privileges(False)

    def privileges(self, require: bool) -> RealtimeSettings:
        """Return what to ask the system for, and whether the robot is to stop if that is refused."""
        return RealtimeSettings(
            priority=self.priority,
            lock_memory=self.lock_memory,
            hold_cpu_latency=self.hold_cpu_latency,
            freeze_collector=self.freeze_collector,
            affinity=tuple(self.affinity),
            require=require,
        )

    def limits(self) -> LoopLimits:
        """Return when the loop stops the robot by itself."""
        return LoopLimits(
            brain_timeout_s=LoopLimits.brain_timeout_s if self.brain_timeout_s is None else self.brain_timeout_s,
            plant_timeout_s=self.plant_timeout_s,
            most_misses=self.most_misses,
            most_catch_up=self.most_catch_up,
        )


def check_view(view: bool, robot: Any) -> None:
    """Refuse to show what is not simulated.

    Args:
        view: the option.
        robot: the robot's configuration.

    Raises:
        ConfigError: names what shows the robot instead.
    """
    if view and (not hasattr(robot, "plant") or robot.plant):
        instead = "; bhd-monitor --3d shows it in a browser" if hasattr(robot, "plant") else ""
        raise ConfigError(f"--view=true shows a simulation, and {robot.type!r} is not simulated here{instead}.")
