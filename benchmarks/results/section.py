"""What a section of the results consists of: commands, numbers with their goals, and a picture or two."""

from collections.abc import Callable
from dataclasses import dataclass, field

from benchmarks.results.runner import Ran, Runner


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
    """

    name: str
    title: str
    rows: list[Row] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    commands: list[Ran] = field(default_factory=list)

    def markdown(self) -> list[str]:
        """Return the section as lines of Markdown."""
        lines = [f"## {self.title}", "", "| measured | | goal | |", "|---|---|---|---|"]
        verdict = {True: "met", False: "**missed**", None: ""}
        lines += [f"| {row.what} | {row.value} | {row.goal} | {verdict[row.met]} |" for row in self.rows]
        for remark in self.remarks:
            lines += ["", remark]
        lines += ["", "```bash", *(f"{one.command}   # {one.seconds:.0f} s" for one in self.commands), "```", ""]
        return lines


@dataclass(frozen=True)
class Measure:
    """How a section is made.

    Attributes:
        name: what `--only` calls it.
        title: its heading.
        measure: runs the commands and fills the section.
    """

    name: str
    title: str
    measure: Callable[[Runner, Section], None]
