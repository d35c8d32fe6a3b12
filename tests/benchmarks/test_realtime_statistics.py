import numpy as np
import pytest

from benchmarks.realtime.statistics import LATE_NS, Block, Samples, Spread, late_ratio, paired_ratio, pairs, summarise

PERIOD = 1_000_000


def block(case: str, round_: int, *, condition: str = "idle", wake: float = 20.0, late: int = 0) -> Block:
    return Block(
        case=case,
        condition=condition,
        round=round_,
        ticks=9_999,
        skipped=0,
        late=late,
        wake_p50=wake,
        wake_p99=2 * wake,
        wake_p999=3 * wake,
        wake_max=4 * wake,
        tick_p50=15.0,
        tick_p99=30.0,
        tick_max=60.0,
        period=1000.0,
        count_error=0.0,
    )


def records(due: list[int], lateness: int = 0, duration: int = 10_000) -> np.ndarray:
    start = np.array(due, np.int64)
    return np.stack((start, start + lateness, start + lateness + duration), axis=1)


def test_samples_of_records() -> None:
    samples = Samples.from_records(records([0, PERIOD, 2 * PERIOD], 30_000, 7_000), PERIOD, 0, ("a note",))
    assert samples.wake_ns.tolist() == [30_000] * 3
    assert samples.duration_ns.tolist() == [7_000] * 3
    assert (samples.ticks, samples.elapsed_ns, samples.notes) == (3, 2 * PERIOD + 37_000, ("a note",))


@pytest.mark.parametrize("left_out", [[], [3], [3, 4, 7]])
def test_a_loop_that_counts_its_skips_has_no_count_error(left_out: list[int]) -> None:
    due = [k * PERIOD for k in range(10) if k not in left_out]
    error = Samples.from_records(records(due, 30_000, 20_000), PERIOD, len(left_out)).count_error
    assert error == pytest.approx(0.95)


@pytest.mark.parametrize("late", [0, 400_000, 5_770_000])
@pytest.mark.parametrize("which", [0, -1])
def test_a_late_first_or_last_tick_is_no_count_error(which: int, late: int) -> None:
    rows = records([k * PERIOD for k in range(10)])
    rows[which, 1:] += late
    rows = rows[: 1 if which == 0 else 10]  # the points that pass meanwhile are skipped, so the block ends here
    error = Samples.from_records(rows, PERIOD, (late + 10_000) // PERIOD).count_error
    assert error is not None
    assert 0 <= error <= 1


def test_skips_that_are_not_counted_are_an_error() -> None:
    due = [k * PERIOD for k in range(10) if k not in (3, 4, 7)]
    assert Samples.from_records(records(due), PERIOD, 1).count_error == pytest.approx(-1.01)


def test_a_loop_that_anchors_its_grid_anew_every_tick_loses_ticks() -> None:
    due = [round(k * PERIOD * 1.1) for k in range(1001)]  # each tick due a period after the end of the one before
    samples = Samples.from_records(records(due), PERIOD, 0)
    assert samples.count_error == pytest.approx(-99.01)


def test_samples_without_times_have_no_count_error() -> None:
    assert Samples(np.array([1]), np.empty(0, np.int64), PERIOD, 0).count_error is None


def test_the_numbers_of_a_block() -> None:
    wake = np.arange(1, 1001, dtype=np.int64) * 1000  # 1 to 1000 µs
    samples = Samples(wake, wake // 2, PERIOD, 5, elapsed_ns=1004 * PERIOD + PERIOD // 4)
    result = summarise(samples, "loop", "load", 3)
    assert (result.case, result.condition, result.round) == ("loop", "load", 3)
    assert result.wake_p50 == pytest.approx(500.5)
    assert result.wake_p99 == pytest.approx(np.percentile(np.arange(1, 1001), 99))
    assert result.wake_max == 1000.0
    assert result.tick_p50 == pytest.approx(250.0, abs=0.5)
    assert result.late == 1000 - LATE_NS // 1000
    assert (result.ticks, result.skipped, result.period) == (1000, 5, 1000.0)
    assert result.count_error == pytest.approx(0.75)


def test_a_loop_that_does_nothing_has_no_tick_times() -> None:
    result = summarise(Samples(np.array([5000]), np.empty(0, np.int64), PERIOD, 0), "cyclictest", "idle", 0)
    assert (result.tick_p50, result.tick_p99, result.tick_max) == (None, None, None)


def test_a_block_without_ticks_says_nothing() -> None:
    with pytest.raises(ValueError, match="'loop' has no tick"):
        summarise(Samples(np.empty(0, np.int64), np.empty(0, np.int64), PERIOD, 0), "loop", "idle", 0)


def test_blocks_are_paired_by_round_and_condition() -> None:
    blocks = [
        block("a", 0),
        block("b", 0),
        block("a", 1),
        block("a", 2),
        block("b", 2),
        block("b", 1, condition="load"),
    ]
    assert [(x.round, y.round) for x, y in pairs(blocks, "a", "b", "idle")] == [(0, 0), (2, 2)]
    assert pairs(blocks, "a", "b", "load") == []


def test_a_disturbance_of_both_of_a_pair_leaves_their_ratio_alone() -> None:
    noise = [1.0, 40.0, 1.0, 7.0, 1.0, 1.0]
    blocks = [block("a", k, wake=12.0 * f) for k, f in enumerate(noise)]
    blocks += [block("b", k, wake=10.0 * f) for k, f in enumerate(noise)]
    ratio = paired_ratio(blocks, "a", "b", "idle", "wake_p99")
    assert ratio is not None
    assert (ratio.median, ratio.low, ratio.high) == pytest.approx((1.2, 1.2, 1.2))
    assert ratio.n == 6


def test_a_disturbance_of_one_block_does_not_move_the_median() -> None:
    blocks = [block("a", k, wake=500.0 if k == 4 else 11.0) for k in range(6)] + [
        block("b", k, wake=10) for k in range(6)
    ]
    ratio = paired_ratio(blocks, "a", "b", "idle", "wake_p50")
    assert ratio is not None
    assert ratio.median == pytest.approx(1.1)
    assert ratio.high == pytest.approx(50.0)


def test_without_a_partner_there_is_no_ratio() -> None:
    assert paired_ratio([block("a", 0)], "a", "b", "idle", "wake_p50") is None
    assert late_ratio([block("b", 0)], "a", "b", "idle") is None


def test_a_divisor_of_zero() -> None:
    zero, some = [block("b", 0, wake=0.0)], [block("a", 0, wake=1.0)]
    infinite = paired_ratio(some + zero, "a", "b", "idle", "wake_p50")
    assert infinite is not None
    assert infinite.median == float("inf")
    none = paired_ratio([block("a", 0, wake=0.0), *zero], "a", "b", "idle", "wake_p50")
    assert none is not None
    assert none.median == 1.0


@pytest.mark.parametrize(
    ("ours", "theirs", "ratio"), [(0, 0, 1.0), (9, 9, 1.0), (3, 1, 2.0), (0, 1, 0.5), (299, 99, 3.0)]
)
def test_the_ratio_of_late_ticks(ours: int, theirs: int, ratio: float) -> None:
    found = late_ratio([block("a", 0, late=ours), block("b", 0, late=theirs)], "a", "b", "idle")
    assert found is not None
    assert found.median == pytest.approx(ratio)


def test_a_spread() -> None:
    assert Spread.of([3.0, 1.0, 2.0]) == Spread(2.0, 1.0, 3.0, 3)
    with pytest.raises(ValueError, match="no values"):
        Spread.of([])
