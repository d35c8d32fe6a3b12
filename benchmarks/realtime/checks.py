"""What is demanded of the measured values, and whether they meet it. Pure."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from benchmarks.realtime.statistics import LATE_NS, Block, Spread, late_ratio, paired_ratio

Relation = Literal["<=", ">="]


@dataclass(frozen=True)
class Check:
    """One row of the table of verdicts.

    Attributes:
        name: what was checked.
        condition: ``"idle"`` or ``"load"``, or other words for when it was.
        bound: what is demanded.
        relation: which side of the bound is good.
        measured: the value, None if it was not measured.
        detail: what else there is to say about the value: spread, counts, unit.
        reason: why it was not measured.
    """

    name: str
    condition: str
    bound: float
    relation: Relation = "<="
    measured: float | None = None
    detail: str = ""
    reason: str = ""

    @property
    def verdict(self) -> str:
        """``"met"``, ``"MISSED"`` or ``"not measured"``; a value that is no number is not a measurement."""
        if self.measured is None or math.isnan(self.measured):
            return "not measured"
        met = self.measured <= self.bound if self.relation == "<=" else self.measured >= self.bound
        return "met" if met else "MISSED"

    def as_json(self) -> dict[str, Any]:
        """Return the row, with its verdict, as a mapping that JSON can hold."""
        return asdict(self) | {"verdict": self.verdict}


def of_spread(
    name: str,
    condition: str,
    bound: float,
    spread: Spread | None,
    *,
    relation: Relation = "<=",
    detail: str = "",
    reason: str = "",
) -> Check:
    """Return the check of the median of the blocks; without blocks it was not measured, for the reason given."""
    if spread is None:
        return Check(name, condition, bound, relation, reason=reason or "no block was measured")
    between = f"{spread.low:.2f}–{spread.high:.2f} in {spread.n} blocks"
    return Check(name, condition, bound, relation, spread.median, f"{between}; {detail}" if detail else between)


def loop_checks(
    blocks: Sequence[Block],
    conditions: Sequence[str],
    subject: str,
    title: str,
    missing: Mapping[str, str],
    *,
    twin: str = "twin",
    cyclictest: str = "cyclictest",
    control: str = "thread",
) -> list[Check]:
    """Return the rows about the loop itself.

    Args:
        blocks: all blocks of the run.
        conditions: the conditions of the run.
        subject: the case that is judged.
        title: what to call it.
        missing: why a case has no blocks.
        twin: the case of the C++ twin.
        cyclictest: the case of cyclictest.
        control: the case of the loop as a thread beside pure-Python work.
    """

    def why(*cases: str) -> str:
        return "; ".join(dict.fromkeys(missing[case] for case in cases if case in missing))

    def each(row: Callable[[str], Check]) -> list[Check]:
        return [row(condition) for condition in conditions]

    def ratio(case: str, name: str, value: str, bound: float, relation: Relation = "<=") -> Callable[[str], Check]:
        return lambda condition: of_spread(
            name,
            condition,
            bound,
            paired_ratio(blocks, case, twin, condition, value),
            relation=relation,
            reason=why(case, twin),
        )

    def tick_share(condition: str) -> Check:
        shares = [
            b.tick_p99 / b.period
            for b in blocks
            if b.case == subject and b.condition == condition and b.tick_p99 is not None
        ]
        name = f"{title}: whole tick p99 ÷ period"
        return of_spread(name, condition, 0.25, Spread.of(shares) if shares else None, reason=why(subject))

    def late(condition: str) -> Check:
        ours, theirs = (
            sum(b.late for b in blocks if b.case == case and b.condition == condition) for case in (subject, cyclictest)
        )
        return of_spread(
            f"{title}: late ticks (> {LATE_NS // 1000} µs) ÷ cyclictest's",
            condition,
            1.5,
            late_ratio(blocks, subject, cyclictest, condition),
            detail=f"{ours} and {theirs} late",
            reason=why(subject, cyclictest),
        )

    def count(condition: str) -> Check:
        errors = [
            abs(b.count_error)
            for b in blocks
            if b.case == subject and b.condition == condition and b.count_error is not None
        ]
        name = f"{title}: |executed + skipped − rate × elapsed| [ticks]"
        if not errors:
            return Check(name, condition, 1.0, reason=why(subject) or "no block was measured")
        return Check(name, condition, 1.0, "<=", max(errors), f"the worst of {len(errors)} blocks")

    return [
        *each(ratio(subject, f"{title}: wake-up p99 ÷ C++ twin's", "wake_p99", 1.5)),
        *each(ratio(subject, f"{title}: wake-up p50 ÷ C++ twin's", "wake_p50", 1.2)),
        *each(tick_share),
        *each(late),
        *each(count),
        *each(ratio(control, "negative control: wake-up p50 ÷ C++ twin's", "wake_p50", 10.0, ">=")),
    ]


def exit_status(checks: Sequence[Check]) -> int:
    """Return 1 if a bound was missed, 0 otherwise."""
    return int(any(check.verdict == "MISSED" for check in checks))
