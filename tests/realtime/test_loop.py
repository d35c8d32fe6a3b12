"""The loop on a virtual clock: the grid, overruns, watchdogs and words. Time is a number here; nothing waits."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.estop_word import EstopWord
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Reason, Request, Watchdog
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.block import WORDS, Phase, Word
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.realtime.limits import LoopLimits
from bhd_lerobot.realtime.loop import RealtimeLoop
from tests.control.support import TICK_NS, Rig

MS = 1_000_000
STOPPING_TICKS = 80  # more than a base at this speed needs to come to rest


class VirtualLoop:
    """A loop around a cerebellum with perfect wheels, and the clock that it sleeps on.

    What happens at which tick is written into `script`: executed tick -> what is done before it. Delays and work are in
    nanoseconds, one for each executed tick; the tick after the last of them is punctual and takes no time.
    """

    def __init__(
        self,
        limits: LoopLimits | None = None,
        delays: tuple[int, ...] = (),
        work: tuple[int, ...] = (),
        alive: tuple[Word, ...] = (),
    ) -> None:
        self.now = self.begin = 10**15
        self.rig = Rig()
        self.words = np.zeros(WORDS, np.int64)
        self.rig.cerebellum.estop = EstopWord(1, self.words[Word.ESTOP : Word.ESTOP_LATCHED + 1])
        self.delays, self.work, self.alive = delays, work, set(alive)
        self.script: dict[int, Callable[[], object]] = {}
        self.until = 0  # executed ticks after which the loop is to pause
        self.slots: list[Slot] = []
        self.starts: list[int] = []
        self.counted: list[tuple[int, int, int, int]] = []
        self.served: list[int] = []
        self.given: list[int] = []  # the times that `tick` was called with
        self.passed: list[int] = []  # periods by which the plant went on
        self.modes: list[int] = []
        self.speeds: list[float] = []
        self.watchdogs: list[int] = []
        self.loop = RealtimeLoop(
            self.rig.cerebellum,
            self.words,
            limits or LoopLimits(most_misses=10**6),
            serve=self._serve,
            run=self._run,
            publish=self._publish,
            count=lambda *timing: self.counted.append(timing),
            clock=lambda: self.now,
            sleep=self._sleep,
        )

    def _sleep(self, seconds: float) -> None:
        assert seconds > 0
        self._live()
        self.now += round(seconds * NANOSECONDS)
        self._live()

    def _live(self) -> None:
        for word in self.alive:
            self.words[word] = self.now

    def _serve(self, now_ns: int) -> None:
        self.served.append(now_ns)

    def _run(self, now_ns: int, ticks: int) -> None:
        self.given.append(now_ns)
        self.rig.cerebellum.tick(now_ns)
        self.passed.append(ticks)

    def _publish(self, slot: Slot, started_ns: int, ended_ns: int, grid: TickGrid) -> None:
        tick = len(self.slots)
        self.slots.append(slot)
        self.starts.append(started_ns)
        self.modes.append(self.rig.mode)
        self.speeds.append(self.rig.command[0])
        self.watchdogs.append(int(self.rig.cerebellum.take_flags()[1][0]))
        # A real loop wakes up late, and its tick takes time; the sum is what makes it late.
        self.now += self.work[tick] if tick < len(self.work) else 0
        self.now += self.delays[tick] if tick < len(self.delays) else 0
        self._live()
        self.script.get(tick + 1, lambda: None)()
        if tick + 1 >= self.until:
            self.words[Word.PAUSE] = 1

    def run(self, ticks: int) -> TickGrid:
        self.until = len(self.slots) + ticks
        self.words[Word.PAUSE] = 0
        self.begin = self.now
        self.script.get(0, lambda: None)()
        return self.loop.run(self.now)

    def drive(self, first: int, last: int, speed: float = 0.2) -> None:
        """Send a setpoint before each of these ticks, as a brain that never tires."""
        for tick in range(first, last):
            former = self.script.get(tick, lambda: None)

            def step(former: Callable[[], object] = former) -> None:
                former()
                self.rig.now = max(0, self.now - self.begin)
                self.rig.send(speed)

            self.script[tick] = step


LATE = st.lists(st.integers(0, 5 * TICK_NS), min_size=1, max_size=40).map(tuple)


@pytest.mark.law
@given(delays=LATE, work=LATE, catch_up=st.integers(1, 4))
def test_the_grid_is_absolute_and_every_period_is_accounted_for(delays, work, catch_up):
    loop = VirtualLoop(LoopLimits(most_misses=10**6, most_catch_up=catch_up), delays, work)
    start = loop.now
    ticks = max(len(delays), len(work)) + 2
    grid = loop.run(ticks)
    last = -1
    for slot, started, (due, counted_start, ended, skipped), now, periods in zip(
        loop.slots, loop.starts, loop.counted, loop.given, loop.passed, strict=True
    ):
        assert due == slot.due_ns == start + slot.index * TICK_NS  # never re-anchored
        assert 0 <= started - due < TICK_NS
        assert counted_start == started <= ended
        assert skipped == slot.skipped == slot.index - last - 1
        assert now == due - start  # the cerebellum's time is that of the grid, not of the wake-up
        assert periods == 1 + min(skipped, catch_up)
        last = slot.index
    words = loop.words
    assert grid.executed == ticks
    assert grid.executed + grid.skipped == last + 1  # the periods that passed
    assert words[Word.CATCH_UP_LOST] == last + 1 - sum(loop.passed)
    assert words[Word.CEREBELLUM_ALIVE] == loop.counted[-1][2]


def test_a_clock_that_wakes_a_little_early_is_on_time_and_impossible_grids_are_refused():
    grid = TickGrid(0, 1000)
    assert grid.begin(-1).lateness_ns == 0
    assert grid.begin(999).index == 1
    for period, misses in ((0, 1), (-5, 1), (10, 0)):
        with pytest.raises(ConfigError, match="at least 1"):
            TickGrid(0, period, misses)


@given(misses=st.integers(1, 8))
def test_so_many_misses_in_a_row_are_a_fault_and_one_less_is_not(misses):
    late = 2 * TICK_NS
    for count, expected in ((misses - 1, Mode.HOLD), (misses, Mode.FAULT)):
        # One punctual tick forgives those before it.
        delays = (0, *[late] * count) if count == misses else (0, *[late] * count, 0, *[late] * count)
        loop = VirtualLoop(LoopLimits(most_misses=misses), delays=delays)
        loop.run(2 * misses + 5)
        assert loop.modes[-1] == expected
        raised = [tick for tick, flags in enumerate(loop.watchdogs) if flags & Watchdog.MISSES]
        assert raised == ([] if expected == Mode.HOLD else [misses + 1])  # once: it latches
        assert loop.modes[: misses + 1] == [Mode.HOLD] * (misses + 1)


@settings(max_examples=15)
@given(timeout_ms=st.integers(1, 400), dies=st.integers(1, 60), phase=st.integers(0, TICK_NS - 1))
def test_silence_stops_the_robot_at_its_time_out(timeout_ms, dies, phase):
    """Counted in ticks: the first that starts more than the time-out after the last sign of life, and no other."""
    loop = VirtualLoop(LoopLimits(brain_timeout_s=timeout_ms / 1e3), alive=(Word.BRAIN_ALIVE,))
    ticks = dies + timeout_ms * MS // TICK_NS + STOPPING_TICKS
    start = loop.now

    def die() -> None:
        loop.alive.clear()
        loop.words[Word.BRAIN_ALIVE] = start + (dies - 1) * TICK_NS + phase

    loop.script[dies] = die
    loop.drive(0, ticks)  # the brain's other half goes on sending: that must not move the robot again
    loop.run(ticks)
    last_life = (dies - 1) * TICK_NS + phase
    stopped = loop.modes.index(Mode.STOPPING)
    assert stopped * TICK_NS - last_life > timeout_ms * MS >= (stopped - 1) * TICK_NS - last_life
    assert loop.modes[:stopped] == [Mode.TRACKING] * stopped
    hold = loop.modes.index(Mode.HOLD)
    assert loop.modes[stopped:] == [Mode.STOPPING] * (hold - stopped) + [Mode.HOLD] * (ticks - hold)
    assert loop.speeds[hold:] == [0.0] * (ticks - hold)
    assert np.all(np.diff(loop.speeds[stopped : hold + 1]) <= 0)
    assert loop.watchdogs[stopped] == Watchdog.BRAIN
    assert not any(loop.watchdogs[:stopped])


def test_a_sign_of_life_after_the_silence_and_a_new_setpoint_move_it_again():
    loop = VirtualLoop(LoopLimits(brain_timeout_s=0.05), alive=(Word.BRAIN_ALIVE,))
    loop.script[20] = loop.alive.clear
    loop.script[300] = lambda: loop.alive.add(Word.BRAIN_ALIVE)
    loop.drive(0, 20)
    loop.drive(302, 320)
    loop.run(320)
    assert loop.modes[299] == loop.modes[301] == Mode.HOLD  # life alone moves nothing
    assert loop.modes[-1] == Mode.TRACKING


def test_a_sign_of_life_from_the_future_is_none():
    loop = VirtualLoop(LoopLimits(brain_timeout_s=0.1))
    loop.words[Word.BRAIN_ALIVE] = loop.now + 3600 * NANOSECONDS
    loop.drive(0, 30)
    loop.run(30)
    assert Mode.TRACKING not in loop.modes


def test_an_absent_brain_is_not_watched():
    """A word that was never written belongs to a process that there is not."""
    loop = VirtualLoop(LoopLimits(brain_timeout_s=0.01))
    loop.drive(0, 100)
    loop.run(100)
    assert set(loop.modes) == {Mode.TRACKING}


@settings(max_examples=20)
@given(tick=st.integers(1, 60), delays=LATE)
def test_the_stop_word_takes_effect_at_the_next_executed_tick(tick, delays):
    loop = VirtualLoop(delays=delays)
    loop.drive(0, 100)
    driving = loop.script[tick]

    def press() -> None:
        driving()
        loop.rig.cerebellum.estop.press()

    loop.script[tick] = press
    loop.run(100)
    assert Mode.ESTOP not in loop.modes[:tick]
    assert set(loop.modes[tick:]) == {Mode.ESTOP}
    # The command is a braking one with that tick already, and stays so.
    assert loop.speeds[tick] < loop.speeds[tick - 1] or loop.speeds[tick] == 0.0
    assert np.all(np.diff(loop.speeds[tick - 1 :]) <= 0)
    assert loop.speeds[-1] == 0.0
    assert loop.rig.cerebellum.estop.pressed.all()  # only a reset acknowledges it


def test_reset_and_activation_lead_out_of_an_emergency_stop_between_late_ticks():
    """Requests are answered once a tick, also while ticks are late; a reset is refused until the robot is at rest."""
    loop = VirtualLoop(delays=tuple([0] * 30 + [3 * TICK_NS] * 200))
    answers: list[int] = []
    wanted = [Request.RESET]

    def serve(now_ns: int) -> None:
        if len(loop.slots) > 31 and wanted:
            reason = int(loop.rig.request(wanted[0]).reasons[0])
            answers.append(reason)
            if reason == Reason.ACCEPTED:
                wanted[0:1] = [Request.ACTIVATE] if wanted[0] == Request.RESET else []

    loop.loop._serve = serve
    loop.drive(0, 30)
    loop.script[31] = loop.rig.cerebellum.estop.press
    loop.run(100)
    refusals = answers.count(Reason.NOT_AT_REST)
    assert refusals > 0
    assert answers == [Reason.NOT_AT_REST] * refusals + [Reason.ACCEPTED] * 2
    assert loop.modes[-1] == Mode.HOLD
    assert not loop.rig.cerebellum.estop.pressed.any()


def test_a_pause_ends_the_segment_and_the_next_starts_at_tick_0():
    loop = VirtualLoop(delays=(3 * TICK_NS,))
    seen: list[int] = []
    loop.script[0] = lambda: seen.append(int(loop.words[Word.PHASE]))
    first = loop.run(5)
    assert loop.words[Word.PHASE] == Phase.STANDING
    assert (first.executed, first.skipped) == (5, 2)
    loop.now += 12345 * MS
    begin = loop.now
    second = loop.run(7)
    assert loop.words[Word.SEGMENT] == 2
    assert loop.words[Word.START] == begin
    assert [slot.index for slot in loop.slots[5:]] == list(range(7))
    assert loop.slots[5].due_ns == begin
    assert (second.executed, second.skipped) == (7, 0)
    assert loop.served[5:] == [k * TICK_NS for k in range(7)]
    assert seen == [Phase.STARTING, Phase.STANDING]


@pytest.mark.parametrize("word", [Word.PAUSE, Word.END])
def test_a_word_that_is_set_already_runs_no_tick(word):
    loop = VirtualLoop()
    loop.words[word] = 1
    grid = loop.loop.run()
    assert (grid.executed, len(loop.slots)) == (0, 0)
    assert loop.words[Word.PHASE] == Phase.STANDING
    assert loop.words[Word.START] == loop.now + TICK_NS  # nobody said when: a period from now
