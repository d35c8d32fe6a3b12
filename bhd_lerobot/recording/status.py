"""What a person who records sees: one line with the state of the recording, and a bell when a take begins and ends."""

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.text import Text

from bhd_lerobot.rollout.marks import Marks

_ANSWER_S = 3.0  # so long the answer to a key is shown
_RATE_S = 2.0  # time over which the rate of a robot is counted
_KEPT = 0.95  # share of the frames below which it is said that the robot does not keep the rate


class RecordStatus:
    """The state of a recording on the wall clock, as a line that a terminal refreshes.

    Args:
        console: where it is shown; elsewhere than in a terminal only changes are printed.
        total: number of takes that the dataset is to have.
        fps: frames a second that were asked for [Hz].
        duration_s: longest duration of a take [s].
        driver: returns who drives.
        marks: whose answers to keys are shown.
        bell: whether to ring when a take begins and ends.
    """

    def __init__(
        self,
        console: Console,
        total: int,
        fps: int,
        duration_s: float,
        *,
        driver: Callable[[], str],
        marks: Marks,
        bell: bool,
    ) -> None:
        self._console, self._total, self._fps, self._duration_s = console, total, fps, duration_s
        self._driver, self._marks, self._bell = driver, marks, bell
        self._state, self._take, self._end_s = "starting", 0, 0.0
        self._last = self._rate = ""
        self._answer = "", 0.0
        self._numbers: deque[int] = deque()
        self._checked = 0  # the number of the frame from which on frames are counted for the next check
        marks.answer = self._show_answer

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show it while a recording runs."""
        if not self._console.is_terminal:
            yield
            return
        with Live(get_renderable=self.line, console=self._console, refresh_per_second=5, transient=True):
            yield

    def line(self) -> Text:
        """Return the line: with the answer to the last key, for some seconds, or with what else is of interest."""
        answer, until_s = self._answer if self._console.is_terminal else ("", 0.0)
        now = time.monotonic()
        is_paused = self._marks.is_paused and self._state == "reset"
        parts = [f"take {self._take + 1} of {self._total}", "paused" if is_paused else self._state]
        if self._end_s and not is_paused:
            parts.append(f"{max(0.0, self._end_s - now):.0f} s left")
        if answer and now < until_s:
            parts.append(answer)
        else:
            parts.append(f"{self._driver()} drives")
            parts += ["a pause comes next"] if self._marks.is_paused and self._state == "recording" else []
            parts += [text for text in (self._rate, self._last and f"last: {self._last}") if text]
        return Text(" · ".join(parts), no_wrap=True, overflow="ellipsis")

    def change(self, state: str, take: int, seconds: float = 0.0) -> None:
        """Change the state: of which take, by its number from 0, and for how long it lasts [s]; 0 if not known."""
        self._state, self._take = state, take
        self._end_s = time.monotonic() + seconds if seconds else 0.0
        if not self._console.is_terminal:
            self._console.print(self.line().plain, soft_wrap=True, highlight=False)

    def begin(self, take: int) -> None:
        """A take begins."""
        self._rate = ""
        self._numbers.clear()
        self._checked = 0
        self.change("recording", take, self._duration_s)
        self._ring()

    def end(self, take: int, outcome: str) -> None:
        """A take has ended."""
        self._last = outcome
        self.change("saving", take)
        self._ring()

    def frame(self, number: int) -> None:
        """Count a frame of the running take, by its number on the grid of time; say if the robot does not keep up."""
        numbers, window = self._numbers, round(_RATE_S * self._fps)
        numbers.append(number)
        while number - numbers[0] >= window:
            numbers.popleft()
        if number < self._checked + window:
            return
        self._checked = number - window // 2
        gaps = sum(after - before > 1 for before, after in itertools.pairwise(numbers))
        kept = len(numbers) / window
        is_slow = kept < _KEPT and gaps > 2  # a single hiccup is no rate
        if is_slow and not self._rate:
            self._console.print(
                f"The robot keeps {kept * self._fps:.0f} of the {self._fps} frames a second; the others are left out.",
                soft_wrap=True,
                highlight=False,
            )
        self._rate = f"{kept * self._fps:.0f} of {self._fps} frames/s" if is_slow else ""

    def _show_answer(self, text: str) -> None:
        self._answer = text, time.monotonic() + _ANSWER_S
        if not self._console.is_terminal:  # a terminal may block; there the line shows it
            self._console.print(text, soft_wrap=True, highlight=False, markup=False)

    def _ring(self) -> None:
        if self._bell:
            self._console.bell()
