"""What a training run writes about itself: `metrics.jsonl`, and the progress on the console."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.options.parse import RUN_CONFIG

METRICS_NAME = "metrics.jsonl"
PLOT_NAME = "loss.png"

Row = dict[str, Any]


def write_config(folder: Path, values: dict[str, Any]) -> None:
    """Write the configuration of a run into its folder: the file is there completely, or as before."""
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=110)
    Disk().publish(folder / RUN_CONFIG, text.encode())


TIMING = ("data_s", "update_s", "steps_per_s", "samples_per_s", "eval_s")
"""Keys of a row that differ between two runs of the same seed."""


class MetricsFile:
    """One JSON object a line, for each step that was logged; a line is complete or, after a kill, left out."""

    def __init__(self, path: Path, rows: Sequence[Row] = ()) -> None:
        """Start a file."""
        self.path = path
        self.rows = list(rows)
        Disk().publish(path, "".join(_line(row) for row in self.rows).encode())

    def append(self, row: Row) -> None:
        """Add a row; it is in the file when this returns."""
        self.rows.append(row)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(_line(row))


def read_metrics(path: Path, last_step: int | None = None) -> list[Row]:
    """Return the rows of a metrics file, without a last line that a kill tore, and without those after `last_step`."""
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            break
        if last_step is None or row["step"] <= last_step:
            rows.append(row)
    return rows


def _line(row: Row) -> str:
    # JSON has no word for what is not finite.
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
    return json.dumps(plain) + "\n"


_LONG_S = 2 * 3600.0  # [s] more is worth a line of its own


class RunProgress:
    """A bar in a terminal, elsewhere one line for each row of metrics; with the time left, from the first step on.

    Args:
        slow: what is printed after the first step if several hours are left.
    """

    def __init__(self, console: Console, description: str, total: float, completed: int = 0, *, slow: str = "") -> None:
        self._console, self._slow = console, slow
        self._total, self._first, self._started = total, completed, time.monotonic()
        self._left = ""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[numbers]}"),
            TextColumn("{task.fields[left]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(description, total=total, completed=completed, numbers="", left="")

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        self._started = time.monotonic()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def advance(self, completed: float) -> None:
        """Move the bar."""
        done, is_first = completed - self._first, not self._left
        if done > 0:
            left_s = (self._total - completed) / done * (time.monotonic() - self._started)
            self._left = f"{timedelta(seconds=round(left_s))} left"
            if is_first and left_s > _LONG_S:
                self._console.print(f"{self._left}, by the first step. {self._slow}".rstrip(), soft_wrap=True)
        self._bar.update(self._task, completed=completed, left=self._left)

    def log(self, prefix: str, numbers: str) -> None:
        """Print a row: its numbers beside the bar, or with a prefix on a line of its own."""
        if self._console.is_terminal:
            self._bar.update(self._task, numbers=numbers)
        elif prefix:
            self._console.print(f"{prefix}  {numbers}  {self._left}".rstrip())


def format_numbers(row: Mapping[str, Any], labels: Sequence[tuple[str, str]]) -> str:
    """Return the numbers of a row that have a label, as pairs of key and label, to 4 digits."""
    shown = ((label, row[key]) for key, label in labels if row.get(key) is not None)
    return "  ".join(
        f"{label} {value:,.0f}" if 1e4 <= value < 1e15 else f"{label} {value:.4g}" for label, value in shown
    )


SHOWN = (
    ("loss", "loss"),
    ("held_out_loss", "held-out"),
    ("success", "success %"),
    ("steps_per_s", "steps/s"),
    ("samples_per_s", "samples/s"),
)
"""Keys of a row of metrics that are printed, and their labels."""
