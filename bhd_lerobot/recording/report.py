"""The counts of a recording run, and its summary in the terminal."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.datasets.format.features import LATE, TIME
from bhd_lerobot.errors import counted, quoted
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.progress import ESTOP_STATUS, FAULT_STATUS
from bhd_lerobot.rollout.signals import StopRequest
from bhd_lerobot.rollout.types import Episode

_LEFT_OUT = 0.02  # share of an episode's frames from which on it is said that the robot does not keep the rate


@dataclass
class RecordResult:
    """What a run recorded.

    Attributes:
        root: the dataset.
        output_dir: the run folder.
        episodes: episodes that the dataset holds.
        recorded: episodes that this run added.
        attempts: whether the brain attempts the task; otherwise outcomes mean nothing, and are not shown.
        successes: how many of them were a success.
        outcomes: how many ended how.
        scores: their scores.
        problems: why brains gave up, as text, of the episodes that were no success.
        frames: frames that this run added.
        late: how many of them were later than the timing tolerance permits, on the wall clock.
        simulated_s: time of the episodes that this run added, simulated or on the wall clock [s].
        wall_s: time that this took [s], from the first observation to the last save.
        stopped_by: the signal that ended the run early, or None.
        kept_fps: frames a second that a robot kept which left out more than 2 % of them in most seconds [Hz], or None.
        dropped: images that were dropped because the video encoder was too slow, by camera; the one before stands in
            the place of each.
        fault: why a real robot's fault ended the run, as text; None if none did.
        estop: what pressed the emergency stop that ended the run, as text; None if there was none.
    """

    root: Path
    output_dir: Path
    episodes: int = 0
    recorded: int = 0
    attempts: bool = True
    successes: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    scores: list[float] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    frames: int = 0
    late: int = 0
    simulated_s: float = 0.0
    wall_s: float = 0.0
    stopped_by: StopRequest | None = None
    estop: str | None = None
    fault: str | None = None
    kept_fps: float | None = None
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def succeeded(self) -> str:
        """How many episodes succeeded, as text; empty if none was attempted."""
        return f"{self.successes} of {self.recorded} succeeded" if self.attempts else ""

    @property
    def exit_status(self) -> int:
        """The program's exit status: 0 if the dataset is complete."""
        if self.estop is not None:
            return ESTOP_STATUS
        if self.fault is not None:
            return FAULT_STATUS
        return self.stopped_by.exit_status if self.stopped_by else 0

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds in a second."""
        return self.simulated_s / self.wall_s if self.wall_s > 0 else 0.0

    def count(self, episode: Episode, fps: int) -> None:
        """Count an episode that was saved."""
        self.recorded += 1
        self.successes += episode.outcome.success
        self.outcomes[episode.outcome.event.cause] += 1
        self.scores.append(episode.outcome.score)
        if episode.plan.get("problem") and not episode.outcome.success:
            self.problems[episode.plan["problem"]] += 1
        self.frames += episode.frames
        self.late += int(np.count_nonzero(episode.columns[LATE]))
        self.simulated_s += episode.duration_s(fps)
        if episode.timing.clock == "realtime":
            kept = _kept_fps(episode.columns[TIME], fps)
            if kept < (1 - _LEFT_OUT) * fps:
                self.kept_fps = min(kept, self.kept_fps or kept)


def _kept_fps(time_s: NDArray[np.float64], fps: int) -> float:
    """Return the frames a second that a robot kept: the median over whole seconds, which no single hiccup changes."""
    elapsed = time_s - time_s[0] + 0.5 / fps  # in the middle of its frame, so that jitter puts none into another second
    seconds = int(elapsed[-1])
    if seconds < 2:
        return float((len(elapsed) - 1) / (elapsed[-1] - elapsed[0])) if len(elapsed) > 1 else np.inf
    return float(np.median(np.bincount(elapsed.astype(int), minlength=seconds)[:seconds]))


def print_summary(console: Console, config: RecordConfig, result: RecordResult, video: bool) -> None:
    """Print what the run did; `video` reports whether it left a video."""
    table = Table(title="Recorded", show_header=False, title_justify="left")
    table.add_row("dataset", counted(result.episodes, "episode"))
    table.add_row(
        "this run",
        f"{counted(result.recorded, 'episode')}, {counted(result.frames, 'frame')}, {result.simulated_s:.0f} s"
        f"{' simulated' if not config.is_live else ''}",
    )
    if result.recorded and result.attempts:
        table.add_row("success", f"{result.successes} of {result.recorded}")
        table.add_row("outcomes", ", ".join(f"{name} {count}" for name, count in result.outcomes.most_common()))
        for problem, count in result.problems.most_common(3):
            table.add_row("gave up" if count == 1 else f"gave up {count} times", escape(problem))
        table.add_row("mean score", f"{np.mean(result.scores):.3f}")
    if result.recorded:
        table.add_row(
            "speed",
            f"{result.real_time_factor:.{0 if result.real_time_factor > 9 else 2}f} x real time, {_clock(config)}",
        )
    if result.late:
        share = 100 * result.late / result.frames
        table.add_row("late", f"{counted(result.late, 'frame')}, {share:.1f} % (bhd-data info lists them)")
    files = [
        "config.yaml",
        *(["trajectories.png"] if (result.output_dir / "trajectories.png").is_file() else []),
        *(["episode.mp4", "episode.png"] if video else []),
    ]
    table.add_row("files", ", ".join(files))
    console.print(table)
    # A path stands in one line, however narrow the terminal.
    dataset = (
        f"Dataset: {result.root}" if result.episodes else f"No episode was saved; nothing is left at {result.root}"
    )
    console.print(escape(f"{dataset}\nRun folder: {result.output_dir}"), soft_wrap=True)
    for outcome, what, why in (
        ("estop", "Emergency stop ({}).", result.estop),
        ("fault", "The robot stopped by a fault: {}.", result.fault),
    ):
        if why is not None:
            is_saved = result.outcomes[outcome] > 0
            saved = f"The episode that was running is saved with the outcome '{outcome}', and no other was started."
            again = " with --resume=true" if result.episodes else ": the same command starts again"
            console.print(
                f"[bold]{what.format(escape(why))}[/bold] {saved if is_saved else 'No episode was running.'} "
                f"Clear the cause and continue{again}."
            )
    if result.dropped:
        images = ", ".join(f"{count} of {escape(camera)}" for camera, count in result.dropped.items())
        console.print(f"Images dropped because the video encoder was too slow: {images} (control.image_age).")
    if result.kept_fps is not None:
        console.print(
            f"The robot keeps about {result.kept_fps:.0f} of the {config.dataset.fps} frames a second that were asked "
            f"for; the others were left out. Record with --dataset.fps={result.kept_fps:.0f}, or use fewer or smaller "
            "images."
        )
    if result.stopped_by:
        again = "recorded anew" if config.is_live else "repeated identically"
        console.print(
            f"Stopped by {result.stopped_by.name}. Episodes that were running were dropped, all others are saved. "
            f"Continue with --resume=true: the dropped ones are {again}."
        )
    if result.episodes:
        console.print(escape(f"Look at it with: bhd-data view {quoted(result.root)}"), soft_wrap=True, highlight=False)


def _clock(config: RecordConfig) -> str:
    return "on the wall clock" if config.is_live else f"n_envs = {config.n_envs}"
