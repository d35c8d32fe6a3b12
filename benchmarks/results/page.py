"""The page of the results, from what was measured and kept."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks._report import Row
from benchmarks.results.rows import Rows
from benchmarks.results.runner import Part, Ran, read_parts
from benchmarks.results.table import Table

_HEAD = """# Results

Written by `make results`, which runs the commands below each table, whose numbers nobody typed. Rates are
with their Wilson 95 % intervals, means and differences with Student's, corrected for skewness, ratios with
Fieller's (bootstrap intervals where a section says so), over the same held-out episodes for all brains of a
table. Those of scores, of their differences and of their ratios also hold what these would be if 3 / n of the
episodes had scored 0, or 1; before 2026-11-28 those of differences and ratios did not, and were too narrow where
failures are rare. All trainings of a recipe meet the same episodes: the interval of their mean success is over
both, Student's over the trainings and Wilson's over the episodes put together (Zou and Donner, 2008); of
trainings that fail now and then three say little. Times of training include the start of the program; those of
aggregation are its rounds'. A goal is for the estimate, unless it names an end of the interval. Where several
training seeds are shown, each has to meet the goal by itself, so intervals are not corrected for their number.
Privileged state is what the simulator tells and no robot measures. Each section says when and where it was made,
and with which commit, if known; `make results RESULTS=--kept` writes the page again from what was measured.
"""


def read(table: Table, kept: Path) -> dict[str, dict[tuple[str, int | None], Part]]:
    """Return what was kept, by section, and by the part's name and the training seed, None of what was run once."""
    everything, found = read_parts(kept), {}
    for name, section in table.sections.items():
        keys: dict[tuple[str, int | None], str] = {(name, None): name} if "once" in section else {}
        keys |= {(part, seed): f"{part}_{seed}" for part in section.get("parts", {}) for seed in table.seeds}
        found[name] = {key: everything[word] for key, word in keys.items() if word in everything}
    return found


def write(table: Table, kept: Path) -> tuple[str, list[str]]:
    """Return the page, with the sections that were measured, and the goals that were missed."""
    texts, missed = [_HEAD], []
    everything = read(table, kept)
    every_part = {key: part for parts in everything.values() for key, part in parts.items()}
    for name, parts in everything.items():
        # Of what was run once alone nothing is shown but what it measured itself.
        if any(part.measured for part in parts.values()):
            rows = [*_rows(table, name, every_part), *_processor_rows(name, parts)]
            texts.append("\n".join(_section(table.sections[name], parts, rows)))
            missed += [f"{name}: {row.what}" for row in rows if row.met is False]
    return "\n".join(texts), missed


def _rows(table: Table, name: str, parts: Mapping[tuple[str, int | None], Part]) -> Iterator[Row]:
    once = parts.get((name, None))
    if once is not None and "rows" in once.measured:
        yield from (Row(**row) for row in once.measured["rows"])
    rows = Rows(name, parts, table.seeds)
    for spec, words in table.expand(table.sections[name].get("rows", ())):
        yield from rows.make(spec, words)


def _processor_rows(name: str, parts: Mapping[tuple[str, int | None], Part]) -> Iterator[Row]:
    """Yield the rows of what all that was recorded and trained for a seed took, each command once."""
    shared = parts[name, None].commands if (name, None) in parts else []
    for (part, seed), one in parts.items():
        if part == name and seed is not None:
            once = {ran.command: ran.cpu_seconds for ran in (*shared, *one.commands)}
            making = ("bhd-record", "bhd-train", "bhd-data")
            seconds = sum(cpu for command, cpu in once.items() if command.startswith(making))
            yield Row(f"seed {seed}: processor time of all its recordings and trainings", f"{seconds:.0f} s")


def _section(
    section: Mapping[str, Any], parts: Mapping[tuple[str, int | None], Part], rows: Sequence[Row]
) -> Iterator[str]:
    """Yield the lines of a section."""
    once: dict[str, Ran] = {}  # parts may have commands in common
    seeds: dict[str, list[int]] = {}
    known = []
    for (_, seed), part in parts.items():
        known += [part.made, *(one.made for one in part.commands)]
        for one in part.commands:
            once.setdefault(one.command, one)
        if seed is not None and seed not in seeds.setdefault(part.made, []):
            seeds[part.made].append(seed)
    yield from (f"## {section['title']}", "", f"Made {max(known)}.", "", "| measured | | goal | |", "|---|---|---|---|")
    verdict = {True: "met", False: "**missed**", None: ""}
    yield from (f"| {row.what} | {row.value} | {row.goal} | {verdict[row.met]} |" for row in rows)
    for made, those in seeds.items():
        *others, last = sorted(those)
        which = f"Seeds {', '.join(map(str, others))} and {last} were" if others else f"Seed {last} was"
        yield from ("", f"{which} made {made}.")
    for remark in section.get("remarks", ()):
        if isinstance(remark, str):
            yield from ("", remark)
        else:
            is_there = any(part == remark["part"] for part, _ in parts)
            yield from ("", remark["text" if is_there else "otherwise"])
    yield from ("", "```bash")
    for one in once.values():
        processor = f", {one.cpu_seconds:.0f} s of processor time" if one.cpu_seconds else ""
        yield f"{one.command}   # {one.seconds:.0f} s{processor}"
    yield from ("```", "")
