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
    "Written by `make results`, which runs the commands below each table; no number was typed by hand. Rates are",
    "with their Wilson 95 % intervals, means and differences with Student's, corrected for skewness (bootstrap",
    "intervals where a section says so), over the same held-out episodes for all brains of a table. Times of training",
    "include the start of the program. Where several training seeds are shown, each has to meet the goal by itself, so",
    "intervals are not corrected for their number; learned rows without a seed (clones, ablations, ACT, Diffusion) are",
    "of the first seed that was made. Each section says when and where it was made.",
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
        # It begins with the date.
        made = max((one.made for one in section.commands if one.made), default=provenance(REPOSITORY))
        texts[section.title] = "\n".join([first, "", f"Made {made}.", *rest])
    lines = [*_HEAD, *(("", _SHORT) if is_short else ())]
    lines += ["\n" + texts[title].strip() for title in titles if title in texts]
    # What other sessions took hours for is on it: it is never half written.
    Disk().publish(path, ("\n".join(lines) + "\n").encode())


def _kept(page: str) -> dict[str, str]:
    """Return the sections of a page by their titles."""
    texts = page.split("\n## ")[1:]
    return {text.partition("\n")[0]: f"## {text}" for text in texts}
