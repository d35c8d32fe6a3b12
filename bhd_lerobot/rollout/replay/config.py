"""Configuration of `bhd-replay`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from lerobot.robots.config import RobotConfig

import bhd_lerobot.registry  # noqa: F401  registers our robots
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf, Options, Range
from bhd_lerobot.robots.external.config import GateConfig


@dataclass
class ReplayDatasetConfig:
    """Which episode is replayed. The names are those of `lerobot-replay`.

    Attributes:
        repo_id: name of the dataset; not needed with `root`.
        root: folder of the dataset; LeRobot's default place of `repo_id` if not set.
        episode: its number in the dataset.
    """

    repo_id: str | None = None
    root: str | None = None
    episode: int = 0


@dataclass
class ReplayConfig(Options):
    """Replay a recorded episode, in simulation or on a robot, and report how far it diverges from the recording.

    Attributes:
        dataset: which episode.
        mode: `open_loop`, `state`, or `both`.
        output_dir: where the plots go; `outputs/replay` if not set.
        tolerance_m: largest position difference that counts as the same [m]; beyond it the exit status is 1.
        robot: a robot that the recorded actions are sent to, of LeRobot or of a plug-in, or one of ours on the wall
            clock; by default the episode is simulated.
        gate: limits of what is sent to a robot of another package.
    """

    dataset: ReplayDatasetConfig = field(default_factory=ReplayDatasetConfig)
    mode: Annotated[str, OneOf(("open_loop", "state", "both"))] = "both"
    output_dir: str | None = None
    tolerance_m: Annotated[float, Range("[0, inf]")] | None = None
    robot: RobotConfig | None = None
    gate: GateConfig = field(default_factory=GateConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.robot is not None and self.tolerance_m is not None:
            raise ConfigError(
                "tolerance_m and robot are both given, and not all that a robot observes is in metres. Leave one of "
                "them out; the differences are printed in any case."
            )
        if self.robot is not None and (self.mode != "both" or self.output_dir is not None):
            raise ConfigError(
                "mode and output_dir are of a replay in simulation, and robot is given. Leave them out, or leave robot "
                "out."
            )
        if self.robot is None and self.gate != GateConfig():
            raise ConfigError("gate is set, and no robot to send the actions to. Add --robot.type, or leave gate out.")


def root_of(config: ReplayConfig) -> Path:
    """Return the folder of the dataset."""
    if config.dataset.root:
        return Path(config.dataset.root).expanduser()
    if config.dataset.repo_id:
        return default_root(config.dataset.repo_id)
    raise ConfigError("No dataset is given; set --dataset.root=FOLDER, or --dataset.repo_id=user/name.")
