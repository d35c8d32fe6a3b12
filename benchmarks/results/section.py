"""What a section of the results consists of: commands, numbers with their goals, and an image or two."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

from scipy.stats import sem
from scipy.stats import t as student

from benchmarks.results.runner import Ran
from bhd_lerobot.evaluation.statistics import Estimate, wilson


@dataclass(frozen=True)
class Row:
    """A number that was measured.

    Attributes:
        what: what was measured.
        value: the number, in words.
        goal: what it should be, in words; nothing if there is no goal.
        met: whether it is; None without a goal.
    """

    what: str
    value: str
    goal: str = ""
    met: bool | None = None


@dataclass
class Section:
    """Part of the results page.

    Attributes:
        name: what `--only` calls it.
        title: its heading.
        rows: the numbers.
        remarks: sentences under the table.
        commands: what was run for it.
        made_before: training seeds that are from earlier runs, by when, where and with what they were made, in words.
        processor_s: of all that was recorded and trained for each training seed, how much processor time it took [s].
    """

    name: str
    title: str
    rows: list[Row] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    commands: list[Ran] = field(default_factory=list)
    made_before: dict[str, set[int]] = field(default_factory=dict)
    processor_s: dict[int, float] = field(default_factory=dict)

    def markdown(self) -> list[str]:
        """Return the section as lines of Markdown."""
        lines = [f"## {self.title}", "", "| measured | | goal | |", "|---|---|---|---|"]
        verdict = {True: "met", False: "**missed**", None: ""}
        spent = [
            Row(f"seed {seed}: processor time of all its recordings and trainings", f"{seconds:.0f} s")
            for seed, seconds in sorted(self.processor_s.items())
        ]
        lines += [f"| {row.what} | {row.value} | {row.goal} | {verdict[row.met]} |" for row in (*self.rows, *spent)]
        for made, seeds in self.made_before.items():
            *others, last = sorted(seeds)
            which = f"Seeds {', '.join(map(str, others))} and {last} were" if others else f"Seed {last} was"
            lines += ["", f"{which} made {made}."]
        for remark in self.remarks:
            lines += ["", remark]
        once: dict[str, Ran] = {}  # a training, and what is shown beside it, may have commands in common
        for one in self.commands:
            once.setdefault(one.command, one)
        commands = [
            f"{one.command}   # {one.seconds:.0f} s, {one.cpu_seconds:.0f} s of processor time" for one in once.values()
        ]
        return [*lines, "", "```bash", *commands, "```", ""]


def rate(estimate: Mapping[str, float | None], outcomes: Mapping[str, int]) -> str:
    """Return a rate with its interval, and how the episodes ended that were no success; a dash for one of nothing."""
    if estimate["value"] is None:
        return "–"
    text = f"{estimate['value']:.1%} ({estimate['low']:.1%} to {estimate['high']:.1%})"
    causes = ", ".join(f"{count} {cause}" for cause, count in outcomes.items() if cause != "success")
    return f"{text}; {causes}" if causes else text


def over_seeds(rates: Sequence[float], episodes: int) -> str:
    """Return the mean success of policies from several training seeds, with its interval, and each of their rates."""
    found = over_trainings(rates, episodes)
    return f"{rate(asdict(found), {})}; {', '.join(f'{one:.1%}' for one in rates)}"


def over_trainings(rates: Sequence[float], episodes: int) -> Estimate:
    """Return the mean success of several trainings that meet the same episodes, with a 95 % interval over both.

    Other trainings would have other rates, and other episodes would shift them all alike. The widths of Student's
    interval over the trainings and of Wilson's over the episodes, of which no training sees others, are added as
    independent errors are: the method of G. Y. Zou and A. Donner, Statistics in Medicine 27 (2008). Student's is not
    corrected for skewness, which three values do not tell, and takes trainings that fail now and then for improbable,
    if none of these did.

    Args:
        rates: one of each training, at least two.
        episodes: how many there are.
    """
    value = sum(rates) / len(rates)
    own, half = wilson(round(value * episodes), episodes), student.ppf(0.975, len(rates) - 1) * sem(rates)
    low, high = (math.hypot(half, own.value - end) for end in (own.low, own.high))
    return Estimate(value, max(0.0, value - low), min(1.0, value + high))


def mean(estimate: Mapping[str, float | None], sign: str = "") -> str:
    """Return a mean, a difference (with ``sign`` "+") or a ratio, with its interval if it has one."""
    if estimate["value"] is None:
        return "–"
    if estimate["low"] is None or math.isnan(estimate["low"]):
        return f"{estimate['value']:{sign}.3f} (no interval: all values are the same, or there is one)"
    return f"{estimate['value']:{sign}.3f} ({estimate['low']:{sign}.3f} to {estimate['high']:{sign}.3f})"
