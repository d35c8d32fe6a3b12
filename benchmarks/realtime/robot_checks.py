"""What is demanded of robots on the wall clock beyond their loop, and whether they meet it. Pure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.realtime.checks import Check, of_spread
from benchmarks.realtime.injections import Drops, Losses, PlantStop, Stops
from benchmarks.realtime.statistics import Block, Spread, paired_ratio

PLANT_MS = 20.0
_TICK_MS = 1.0


@dataclass(frozen=True)
class Pair:
    """Two cases that are compared.

    Attributes:
        name: what the row is called.
        case: the numerator.
        other: the denominator.
        bound: the largest good ratio.
    """

    name: str
    case: str
    other: str
    bound: float


def ratio_checks(
    pair: Pair, blocks: Sequence[Block], conditions: Sequence[str], missing: Mapping[str, str]
) -> list[Check]:
    """Return the rows that compare the 99th percentiles of two cases: of the wake-up and of the whole tick.

    Args:
        pair: the cases.
        blocks: all blocks of a run.
        conditions: the conditions of the run.
        missing: why a case has no blocks.
    """
    reason = "; ".join(dict.fromkeys(missing[case] for case in (pair.case, pair.other) if case in missing))

    def ratio(condition: str, value: str) -> Spread | None:
        return paired_ratio(blocks, pair.case, pair.other, condition, value)

    return [
        of_spread(f"{pair.name}: {what}", condition, pair.bound, ratio(condition, value), reason=reason)
        for what, value in (("wake-up p99", "wake_p99"), ("whole tick p99", "tick_p99"))
        for condition in conditions
    ]


def recording_checks(
    reports: Sequence[Mapping[str, Any]], cases: Mapping[str, str], missing: Mapping[str, str]
) -> list[Check]:
    """Return the rows about what real recording runs counted.

    Args:
        reports: what the owners of robots said of each block, with ``case`` and ``count_error``.
        cases: titles of the cases that record.
        missing: why a case has no blocks.
    """
    checks = []
    for case, title in cases.items():
        mine = [report for report in reports if report["case"] == case]
        reason = "" if mine else missing.get(case, "no block was measured")
        errors = [abs(report["frames"] + report["drops"] - report["frames_due"]) for report in mine]
        due, drops = (sum(report[key] for report in mine) for key in ("frames_due", "drops"))
        ticks = [abs(float(report["count_error"])) for report in mine]
        said = f"{due} frames were due, {drops} dropped and counted, in {len(mine)} episodes"
        checks += [
            Check(
                f"{title}: |executed + skipped − rate × elapsed| [ticks]",
                "recording",
                1.0,
                measured=max(ticks, default=None),
                detail=f"the worst of {len(mine)} episodes",
                reason=reason,
            ),
            Check(
                f"{title}: |recorded + counted drops − frames due|",
                "recording",
                0.0,
                measured=max(errors, default=None),
                detail=said,
                reason=reason,
            ),
        ]
    return checks


def stop_checks(stops: Mapping[tuple[str, str], Stops], reason: str) -> list[Check]:
    """Return the rows about emergency stops; one that never came counts as infinitely late."""
    name = "emergency stop to safe command [executed ticks], every one"
    checks = []
    for (robot, condition), some in stops.items():
        if not some.stops:
            continue
        ticks = [math.inf if stop.ticks is None else float(stop.ticks) for stop in some.stops]
        rest = [stop.stop_ms for stop in some.stops if stop.stop_ms is not None]
        detail = f"{len(ticks)} stops; {sum(t <= 1 for t in ticks)} within 1 tick"
        if rest:
            detail += f"; at rest after {max(rest):.0f} ms at the most"
        if some.unsure:
            detail += f"; {some.unsure} presses were interrupted and repeated"
        detail += "".join(f"; {why}" for why in dict.fromkeys(stop.why for stop in some.stops if stop.why))
        checks.append(Check(f"{robot}: {name}", condition, 2.0, measured=max(ticks, default=None), detail=detail))
    if reason or not checks:
        checks.append(Check(name, "idle", 2.0, reason=reason or "it was not done"))
    return checks


def loss_checks(losses: Losses | None, reason: str) -> list[Check]:
    """Return the rows about brains that were stopped or killed."""
    name = "brain lost → the robot stops, relative to the time-out [ticks]"
    if losses is None:
        return [Check(name, "idle", 1.0, reason=reason or "it was not done")]
    checks = []
    for (what, watchdog), some in losses.by_kind.items():
        errors = [math.inf if one.error_ticks is None else abs(one.error_ticks) for one in some]
        held = [math.inf if one.hold_ms is None else one.hold_ms for one in some]
        detail = f"{len(some)} times; HOLD {max(held, default=math.inf):.0f} ms after the time-out at the latest"
        worst = math.inf if math.inf in held else max(errors, default=None)
        checks.append(Check(f"{what}, {watchdog}: {name}", "idle", 1.0, measured=worst, detail=detail))
    took = max(losses.ended_s, default=0.0)
    checks.append(
        Check(
            "brain killed: processes and shared memory left behind",
            "idle",
            0.0,
            measured=float(len(losses.left)) if losses.ended_s else None,
            detail=", ".join(losses.left) or f"{len(losses.ended_s)} times; all had ended {took:.1f} s after HOLD",
            reason="" if losses.ended_s else "no brain was killed",
        )
    )
    return checks


def drop_check(drops: Drops | None, reason: str) -> Check:
    """Return the row about a recorder that was stopped for so long that states were lost."""
    name = "recorder stopped: |states published − taken − counted drops|"
    if drops is None:
        return Check(name, "idle", 0.0, reason=reason or "it was not done")
    detail = f"{drops.published} published, {drops.taken} taken, {drops.counted} counted as dropped"
    if drops.counted == 0 and drops.error == 0:
        return Check(name, "idle", 0.0, reason=f"nothing was lost ({detail}): the recorder was stopped too shortly")
    return Check(name, "idle", 0.0, measured=float(abs(drops.error)), detail=detail)


def plant_check(stops: Sequence[PlantStop] | None, reason: str) -> Check:
    """Return the row about cerebellums that were killed."""
    name = "cerebellum killed, plant process on: plant stopped after [ms]"
    if not stops:
        return Check(name, "idle", PLANT_MS + _TICK_MS, reason=reason or "it was not done")
    rest = [math.inf if stop.rest_ms is None else stop.rest_ms for stop in stops]
    detail = f"{len(stops)} times; joints at rest after {max(rest):.0f} ms at the most"
    worst = math.inf if math.inf in rest else max(stop.stop_ms for stop in stops)
    return Check(name, "idle", PLANT_MS + _TICK_MS, measured=worst, detail=detail)
