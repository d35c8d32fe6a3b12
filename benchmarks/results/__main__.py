"""`make results`: everything that is claimed about learning and speed, made again, into `docs/reference/results.md`.

It takes hours. A command that was run is not run again: `outputs/results` keeps what it made; remove it to begin anew.
With `--only`, the other sections of the page stay as they were measured. `--episodes N` tries the commands: it records
and evaluates N episodes and writes a page of its own.
"""

import argparse
import sys
from contextlib import closing
from pathlib import Path

from benchmarks._turns import status
from benchmarks.results import page
from benchmarks.results.runner import REPOSITORY, FailedError, Runner
from benchmarks.results.table import Table
from bhd_lerobot.datasets.storage.disk import Disk

_KEPT = Path("docs/reference/results.json")


def main(arguments: list[str] | None = None) -> int:
    """Make the results; return 0, 3 if a goal was missed, or 2 if a command failed."""
    out = Path("outputs/results")
    sections = list(Table(out).sections)
    parser = argparse.ArgumentParser(prog="make results", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=sections, default=sections, help="sections to make")
    parser.add_argument("--episodes", type=int, help="record and evaluate so few, into outputs/results_N")
    parser.add_argument("--folder", type=Path, help=f"where everything goes; {out} or {out}_N if left out")
    parser.add_argument("--kept", action="store_true", help="run nothing: write the page again from what was measured")
    options = parser.parse_args(arguments)
    if options.episodes is not None and options.episodes < 1:
        parser.error(f"--episodes is {options.episodes}; it must be at least 1.")
    is_full = options.episodes is None and options.folder is None
    out = options.folder or (out if options.episodes is None else Path(f"{out}_{options.episodes}"))
    kept = REPOSITORY / (_KEPT if is_full else out / "results.json")
    table, failed = Table(out), []
    if not options.kept:
        try:
            run = Runner(out, options.episodes)
        except FailedError as error:
            print(error, file=sys.stderr)
            return 2
        with closing(run):
            for name in options.only:
                try:
                    run.make(table.sections[name], name, table, kept)
                except FailedError as error:
                    failed.append(f"{name}: {error}")
                except KeyboardInterrupt:
                    print("Stopped. The same command goes on with what is not done yet.", file=sys.stderr)
                    return 130
                _write(table, kept)  # what takes hours may be stopped
    missed = _write(table, kept)
    print("\n".join(failed), file=sys.stderr, end="\n" if failed else "")
    print(f"Written: {kept.with_suffix('.md')}.", *(f"Missed: {one}." for one in missed), sep="\n")
    return 2 if failed else status(met=not missed or options.kept or not is_full)


def _write(table: Table, kept: Path) -> list[str]:
    """Write the page; return the goals that were missed."""
    text, missed = page.write(table, kept)
    Disk().publish(kept.with_suffix(".md"), text.encode())
    return missed


if __name__ == "__main__":
    sys.exit(main())
