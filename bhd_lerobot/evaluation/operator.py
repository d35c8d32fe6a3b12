"""A person beside a real robot who sets up scenes and judges, and the order in which the brains run."""

import contextlib
import json
import random
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from bhd_lerobot.evaluation.results import write_json
from bhd_lerobot.rollout.marks import KEYS, Marks
from bhd_lerobot.rollout.types import EpisodeSpec

_POLL_S = 0.05
_JUDGING = tuple(key for key in KEYS if key.meaning in ("success", "failure"))


def drawn_orders(folder: Path, labels: Sequence[str], indices: Sequence[int]) -> dict[str, list[str]]:
    """Return in which order the brains run each episode, by its number, as drawn when the evaluation in a folder began.

    An order that followed from the seed would be the same in every evaluation, and a person would come to know it.
    What is left of an evaluation of other brains or episodes, or half written, is drawn anew.
    """
    path, chance = folder / "order.json", random.SystemRandom()
    orders = {str(index): chance.sample(labels, len(labels)) for index in indices}
    with contextlib.suppress(OSError, ValueError, AttributeError, TypeError):
        drawn = dict(json.loads(path.read_text(encoding="utf-8")))
        if {index: sorted(order) for index, order in drawn.items()} == dict.fromkeys(orders, sorted(labels)):
            return drawn
    write_json(path, orders)
    return orders


class Operator(Marks):
    """A person at the terminal, who is not told which brain runs; `is_there`: whether a terminal gives keys."""

    def __init__(self, console: Console, total: int, outcomes: Sequence[str]) -> None:
        super().__init__(1, outcomes, _JUDGING)
        self._console, self._total = console, total
        self.is_there = self.has_quit = False
        self._title = ""

    def on_key(self, keys: bytes) -> None:
        """Take keys of a terminal: q, and those of `Marks`."""
        self.has_quit |= b"q" in keys.lower()
        super().on_key(keys)

    def set_up(self, number: int, spec: EpisodeSpec, instruction: str, stop: Callable[[], bool]) -> None:
        """Wait until the person has set up a scene, or the run ends; `number` counts all brains' episodes from 1."""
        self._title = f"Episode {number} of {self._total}"
        if not self.is_there:
            return
        words = f" ({escape(instruction)})" if instruction else ""
        with self.waiting() as is_pressed:
            self._say(f"{self._title}, scene {spec.index}{words}: set up the scene, then press Enter")
            while not (is_pressed() or stop()):
                time.sleep(_POLL_S)

    def begin(self, simulations: NDArray[np.intp]) -> None:
        """Begin an episode: from now on keys judge it."""
        super().begin(simulations)
        if self.is_there:
            self._say(f"{self._title} runs: s success, f failure, q end the evaluation")

    def _say(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, highlight=False)  # a script looks for whole lines
