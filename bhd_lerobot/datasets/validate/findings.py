"""What a check or a repair of a dataset finds."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from bhd_lerobot.datasets.format.features import names_of

FIX = "bhd-data check --fix"
"""Of remedies: what the command corrects by itself."""


class Severity(IntEnum):
    """How bad a finding is."""

    NOTE = 0
    WARNING = 1
    ERROR = 2

    @property
    def word(self) -> str:
        """Its name."""
        return self.name.lower()


@dataclass(frozen=True)
class Finding:
    """One fact about a dataset that a check or a repair found.

    Attributes:
        severity: error: a program fails on it or learns something wrong, or data are lost; warning: to be inspected by
            a person; note: for information.
        check: the check that found it, one of `CHECKS`.
        where: the file, or the feature and the place in it.
        what: the fact, with its numbers.
        remedy: what to do about it; empty for notes and for losses.
    """

    severity: Severity
    check: str
    where: str
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


@dataclass
class Findings:
    """Findings in the order in which they were added."""

    items: list[Finding] = field(default_factory=list)

    def __iter__(self) -> Iterator[Finding]:
        """Iterate over the findings, the worst first, otherwise in the order in which they were added."""
        return iter(sorted(self.items, key=lambda finding: -finding.severity))

    def error(self, check: str, where: str, what: str, remedy: str = "") -> None:
        """Add an error."""
        self.items.append(Finding(Severity.ERROR, check, where, what, remedy))

    def warning(self, check: str, where: str, what: str, remedy: str) -> None:
        """Add a warning."""
        self.items.append(Finding(Severity.WARNING, check, where, what, remedy))

    def note(self, check: str, where: str, what: str) -> None:
        """Add a note."""
        self.items.append(Finding(Severity.NOTE, check, where, what))


def name_of(feature: Mapping[str, Any], element: int) -> str:
    """Return the name of one of a feature's numbers."""
    names = names_of(feature)
    return names[element] if element < len(names) else f"number {element}"


def one_line(error: object) -> str:
    """Return the message of an error on one line."""
    return " ".join(str(error).split()).rstrip(".")
