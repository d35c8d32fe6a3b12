"""An episode: its specification and its result."""

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, CommandResult
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.realtime.timing import TimingSummary
from bhd_lerobot.rollout.drivers import Intervention
from bhd_lerobot.tasks.task import Outcome


@dataclass(frozen=True)
class EpisodeSpec:
    """An episode to be run: its number in the run, and the seed that decides everything random in it."""

    index: int
    seed: int


@dataclass(frozen=True)
class Episode:
    """An episode that was run.

    Attributes:
        spec: its number and seed.
        scene: where it was: an `Arena` or a `TableScene`.
        instruction: the instruction that the brain followed, or that of the task.
        initial_state: the simulator's complete state at its start, shape (nstate,).
        columns: the dataset's columns by key, each of shape (frames, ...), images left out.
        outcome: how it ended.
        timing: how punctual its control ticks were.
        writer: what was given for the episode's images at its start, or None.
        commands: the goals that the brain gave, each with the frame in which it gave it; None if it gave setpoints.
        results: how goals ended, each with the frame in which it did.
        goal_frames: spans of the frames, first and end, that followed goals while the brain gave setpoints in the
            others; None if it gave none.
        plan: the brain's plan, as plain values, if it has one.
        realtime: what the real-time process was granted and refused; None on the lockstep clock.
        interventions: when an expert or a person drove, in order; None if none could take over.
    """

    spec: EpisodeSpec
    scene: Any
    instruction: str
    initial_state: NDArray
    columns: dict[str, NDArray]
    outcome: Outcome
    timing: TimingSummary
    writer: Any
    commands: list[tuple[int, BrainCommand]] | None = None
    results: list[tuple[int, CommandResult]] = field(default_factory=list)
    goal_frames: list[tuple[int, int]] | None = None
    plan: dict[str, Any] = field(default_factory=dict)
    realtime: list[dict[str, Any]] | None = None
    interventions: list[Intervention] | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.columns[keys.ACTION])

    def duration_s(self, fps: int) -> float:
        """Return how long it lasted [s]; on the wall clock as measured: a robot that is too slow leaves frames out."""
        if self.timing.clock == "lockstep":
            return self.frames / fps
        time_s = self.columns[keys.TIME]
        return float(time_s[-1] - time_s[0]) + 1 / fps
