"""What every run of episodes shows in the terminal, and its exit status."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bhd_lerobot.robots.host.robots import Robots

ESTOP_STATUS = 3  # exit status of a run that an emergency stop ended
FAULT_STATUS = 4  # of one that a real robot's fault ended


def progress_bars(console: Console, *fields: str) -> Progress:
    """Return bars that also show some fields of their tasks, by name."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *(TextColumn(f"{{task.fields[{field}]}}") for field in fields),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=console,
    )


def part_done(loop: Any) -> float:
    """Return how much of the running episodes is done, in episodes; each is taken to last as long as it may."""
    return float(loop.task.frame[loop.robots.running].sum() / loop.task.max_frames)


def print_notes(console: Console, robots: Robots, task: Any = None) -> None:
    """Print what has to be known of robots and task before they begin."""
    for note in (*robots.notes, *getattr(task, "notes", ())):
        console.print(note, soft_wrap=True, highlight=False)
