"""The loop of the cerebellum in real time: ticks on an absolute grid, and a watchdog on the brain's process.

The clock and the sleep are given, so that everything in here runs on a virtual clock in tests.
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.kernels import fence
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Watchdog
from bhd_lerobot.realtime.block import Phase, Word
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.realtime.limits import LoopLimits

_BRAIN_ALIVE = int(Word.BRAIN_ALIVE)  # a plain number: an index of an enumeration costs a call

Run = Callable[[int, int], None]
"""Runs a tick of the cerebellum, at a time of its own [ns], and lets the plant continue by a number of ticks."""
Serve = Callable[[int], None]
"""Answers requests of the bridge, at a time of the cerebellum [ns]."""
Publish = Callable[[Slot, int, int, TickGrid], None]
"""Publishes the state: the tick, when it started and when its predecessor ended (both monotonic) [ns], the grid."""
Count = Callable[[int, int, int, int], None]
"""Takes the timing of a tick: due, start, end (monotonic) [ns], ticks skipped before it."""


class RealtimeLoop:
    """Runs ticks until a word says pause or end.

    Args:
        cerebellum: what `run` runs, of one robot.
        words: the block's words.
        limits: when to stop the robot.
        serve: answers requests, before each tick.
        run: runs a tick.
        publish: publishes the state, at the end of each tick.
        count: takes the timing of each tick.
        may_stand: asked after a pause or the end is wanted, before each tick, whether the robot may be left alone; it
            always may if None.
        clock: monotonic time [ns].
        sleep: waits for a time [s].
    """

    def __init__(
        self,
        cerebellum: Cerebellum,
        words: NDArray[np.int64],
        limits: LoopLimits,
        *,
        serve: Serve,
        run: Run,
        publish: Publish,
        count: Count,
        may_stand: Callable[[], bool] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.cerebellum, self.words, self.limits = cerebellum, words, limits
        self.period_ns = NANOSECONDS // cerebellum.control_hz
        self._serve, self._run, self._publish, self._count = serve, run, publish, count
        self._may_stand = may_stand
        self._clock, self._sleep = clock, sleep
        self._brain_timeout_ns = round(limits.brain_timeout_s * NANOSECONDS)

    def run(self, start_ns: int | None = None) -> TickGrid:
        """Run a segment of ticks, until `Word.PAUSE` or `Word.END` is set; return its grid.

        Args:
            start_ns: when tick 0 is due [ns]; one period from now if None.
        """
        words, clock, sleep, period = self.words, self._clock, self._sleep, self.period_ns
        start = clock() + period if start_ns is None else start_ns
        grid = TickGrid(start, period, self.limits.most_misses)
        words[Word.CATCH_UP_LOST] = 0
        words[Word.START] = self.cerebellum.stamp_origin_ns = start
        fence()
        words[Word.SEGMENT] += 1
        words[Word.PHASE] = Phase.RUNNING
        ended = start
        # Plain numbers: an index of an enumeration costs a call.
        pause, end, alive = int(Word.PAUSE), int(Word.END), int(Word.CEREBELLUM_ALIVE)
        while not (words[pause] or words[end]) or (self._may_stand is not None and not self._may_stand()):
            now = clock()
            left = grid.next_due_ns - now
            if left > 0:
                # On Linux this is clock_nanosleep to an absolute time of this clock.
                sleep(left / NANOSECONDS)
                now = clock()
            slot = grid.begin(now)
            self._tick(slot, now, ended, grid)
            ended = clock()
            grid.end(ended)
            self._count(slot.due_ns, now, ended, slot.skipped)
            words[alive] = ended
        words[Word.PHASE] = Phase.STANDING
        return grid

    def _tick(self, slot: Slot, started_ns: int, ended_ns: int, grid: TickGrid) -> None:
        self._watch(started_ns, grid)
        now = slot.due_ns - grid.start_ns
        self._serve(now)
        ticks = 1
        if slot.skipped:
            ticks += min(slot.skipped, self.limits.most_catch_up)
            self.words[Word.CATCH_UP_LOST] += slot.skipped + 1 - ticks
        self._run(now, ticks)
        self._publish(slot, started_ns, ended_ns, grid)

    def _watch(self, now_ns: int, grid: TickGrid) -> None:
        seen = int(self.words[_BRAIN_ALIVE])
        if seen and abs(now_ns - seen) > self._brain_timeout_ns:  # what is from the future never grows old
            self.cerebellum.interrupt(Watchdog.BRAIN, Mode.STOPPING)
        if grid.too_many_misses:
            self.cerebellum.interrupt(Watchdog.MISSES, Mode.FAULT)
