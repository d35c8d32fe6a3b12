"""The page that the results are written to."""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.results.provenance import provenance
from benchmarks.results.runner import REPOSITORY
from benchmarks.results.section import Section
from bhd_lerobot.datasets.storage.disk import Disk

_HEAD = (
    "# Results",
    "",
    "Written by `make results`, which runs the commands below each table, whose numbers nobody typed. Rates are",
    "with their Wilson 95 % intervals, means and differences with Student's, corrected for skewness, ratios with",
    "Fieller's (bootstrap intervals where a section says so), over the same held-out episodes for all brains of a",
    "table. Those of scores, of their differences and of their ratios also hold what these would be if 3 / n of the",
    "episodes had scored 0, or 1; before 2026-11-28 those of differences and ratios did not, and were too narrow where",
    "failures are rare. All trainings of a recipe meet the same episodes: the interval of their mean success is over",
    "both, Student's over the trainings and Wilson's over the episodes put together (Zou and Donner, 2008); of",
    "trainings that fail now and then three say little. Times of training include the start of the program; those of",
    "aggregation are its rounds'. A goal is for the estimate, unless it names an end of the interval. Where several",
    "training seeds are shown, each has to meet the goal by itself, so intervals are not corrected for their number.",
    "Privileged state is what the simulator tells and no robot measures. Each section says when and where it was made,",
    "and with which commit, if known; `make results RESULTS=--kept` writes the page again from what was measured.",
)
_SHORT = "**A short run, to try the commands: these numbers are not to be quoted.**"


def write_page(path: Path, sections: Sequence[Section], titles: Sequence[str], *, is_short: bool) -> None:
    """Write the sections as a page of Markdown; those of the page that were not made now stay as they are.

    Args:
        path: the page.
        sections: what was made now.
        titles: of all sections that there are, in their order; others that the page has are dropped.
        is_short: made by a short run, whose page says so.
    """
    texts = {} if not path.exists() else _kept(path.read_text(encoding="utf-8"))
    for section in sections:
        first, *rest = section.markdown()
        # Each begins with the date. What an earlier version kept of a training does not say it for each command.
        known = [*(one.made for one in section.commands if one.made), *section.made_before]
        made = max(known, default=provenance(REPOSITORY))
        texts[section.title] = "\n".join([first, "", f"Made {made}.", *rest])
    lines = [*_HEAD, *(("", _SHORT) if is_short else ())]
    lines += ["\n" + texts[title].strip() for title in titles if title in texts]
    # What other sessions took hours for is on it: it is never half written.
    Disk().publish(path, ("\n".join(lines) + "\n").encode())


def _kept(page: str) -> dict[str, str]:
    """Return the sections of a page by their titles."""
    texts = page.split("\n## ")[1:]
    return {text.partition("\n")[0]: f"## {text}" for text in texts}
