"""`make results`: everything that is claimed about learning, made again, into `docs/reference/results.md`.

It takes hours. What was done is not done again: `outputs/results` keeps it, `--fresh` begins anew. With `--only`, the
other sections of the page stay as they are; with `--seeds`, what was measured of other training seeds does. With
`--kept` nothing is run: the sections about trainings are written again from what was measured.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event, Lock

from benchmarks._turns import status
from benchmarks.results.adaptation import fine_tune, move_camera
from benchmarks.results.aggregation import aggregate
from benchmarks.results.camera_drive import camera_drive
from benchmarks.results.learning import avoid, reach
from benchmarks.results.monitored import monitored
from benchmarks.results.page import write_page
from benchmarks.results.picking import pick
from benchmarks.results.runner import REPOSITORY, FailedError, Kept, Runner, empty, lock
from benchmarks.results.section import Section
from benchmarks.results.seeing import pixels, see
from benchmarks.results.speed import navigate, speed
from benchmarks.results.trainings import SEEDS

Measure = Callable[[Runner, Section], None]

# Name, title, and what runs the commands and fills the section; in groups of which one section uses what another made.
GROUPS: tuple[tuple[tuple[str, str, Measure], ...], ...] = (
    (("avoid", "Avoid: a TurtleBot3 roams without touching anything, cloned from the simple rule", avoid),),
    (
        ("aggregate", "Avoid, by aggregation: the rule corrects its clone", aggregate),
        ("monitored", "Avoid, by aggregation and then PPO, with the collision monitor", monitored),
    ),
    (("camera_drive", "Avoid, from the front camera: a rule that reads the lidar corrects it", camera_drive),),
    (
        ("reach", "Reach: a UR5 brings its tool to a pose", reach),
        ("fine_tune", "Fine-tune: 10 episodes of a shifted world", fine_tune),
    ),
    (("pick", "Pick, from privileged state: a UR5 picks up what an instruction names", pick),),
    (
        ("see", "Pick, from a camera: a UR5 picks up what an instruction names and what it sees", see),
        ("move_camera", "Fine-tune: 20 tables before a camera that was moved", move_camera),
        ("pixels", "Pick, from pixels: one network at run time, trained in privileged stages, looks once", pixels),
    ),
    (("navigate", "Navigate: a rule drives a TurtleBot3 to a goal", navigate),),
)
_SMALL = ("avoid", "navigate")  # fill what the others leave of the cores at the end
LAST = ("speed", "Speed", speed)  # alone, whatever else runs side by side
MEASURES = (*(one for group in GROUPS for one in group), LAST)
_BENCHMARKS = ("navigate", "speed")  # of which nothing but the page is kept
_FOLDER, _PAGE = "outputs/results", "docs/reference/results.md"


def main(arguments: list[str] | None = None) -> int:
    """Make the results; return 0, 1 if a goal was missed, or 2 if a command failed."""
    names = [name for name, _, _ in MEASURES]
    parser = argparse.ArgumentParser(prog="make results", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="sections to make")
    parser.add_argument("--folder", type=Path, help=f"where everything goes: {_FOLDER}, {_FOLDER}_short")
    parser.add_argument("--page", type=Path, help=f"what is written: {_PAGE}, or results.md in the folder of --short")
    parser.add_argument("--short", action="store_true", help="a short run, which shows in which direction numbers go")
    parser.add_argument("--jobs", type=int, help="sections side by side, each on one core: 1, or 2 with --short")
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        choices=SEEDS,
        help="training seeds to make; the others stay as they were measured before, which lies beside the page",
    )
    parser.add_argument("--fresh", action="store_true", help="begin anew: remove all that is in the folder")
    parser.add_argument("--kept", action="store_true", help="run nothing: write the page again from what was measured")
    options = parser.parse_args(arguments)
    if options.kept:
        return _write_again(REPOSITORY / _FOLDER, REPOSITORY / (options.page or _PAGE), options.only)
    if options.short and 0 not in (options.seeds or [0]):
        parser.error("--short makes training seed 0 only. Leave --seeds out.")
    jobs = (2 if options.short else 1) if options.jobs is None else options.jobs
    if jobs < 1:
        parser.error(f"--jobs is {jobs}; it must be at least 1.")
    folder = REPOSITORY / (options.folder or (f"{_FOLDER}_short" if options.short else _FOLDER))
    page = REPOSITORY / (options.page or (folder / "results.md" if options.short else _PAGE))
    try:
        descriptor = lock(folder)
    except FailedError as error:
        print(error, file=sys.stderr)
        return 2
    try:
        if options.fresh:
            empty(folder)
        return _make(options, folder, page, jobs, descriptor)
    except FailedError as error:
        print(error, file=sys.stderr)
        return 2
    finally:
        os.close(descriptor)


def _write_again(folder: Path, page: Path, only: Sequence[str]) -> int:
    """Write the sections of a page whose measurements are kept; return what `main` does."""
    sections = []
    try:
        for name, title, measure in MEASURES:
            if name in only and name not in _BENCHMARKS:
                run, section = Kept(folder, page), Section(name, title)
                measure(run, section)
                section.commands = run.commands
                sections.append(section)
    except (FailedError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    write_page(page, sections, [title for _, title, _ in MEASURES], is_short=False)
    return 0


def _make(options: argparse.Namespace, folder: Path, page: Path, jobs: int, descriptor: int) -> int:
    """Make the results in a folder that is taken; return what `main` does."""
    sections: list[Section] = []
    writing, stopped = Lock(), Event()

    def make(group: Sequence[tuple[str, str, Measure]]) -> None:
        for name, title, measure in group:
            if name not in options.only:
                continue
            section = Section(name, title)
            run = Runner(
                folder,
                is_short=options.short,
                stopped=stopped,
                chosen=options.seeds,
                kept=page.with_suffix(""),
                lock=descriptor,
            )
            try:
                measure(run, section)
            except FailedError as error:
                raise FailedError(f"{name}: {error}") from None
            section.commands = run.commands
            with writing:
                sections.append(section)
                # After each section: what takes hours may be stopped.
                write_page(page, sections, [title for _, title, _ in MEASURES], is_short=options.short)

    failures = []
    try:
        # The largest first, so that none of them is left to run alone at the end.
        groups = sorted(GROUPS, key=lambda group: (group[0][0] in _SMALL, -len(group)))
        for stage, width in ((groups, jobs), ([(LAST,)], 1)):
            with ThreadPoolExecutor(width) as pool:
                running = [pool.submit(make, group) for group in stage]
                try:
                    failures += [str(error) for one in running if (error := _failure(one)) is not None]
                except KeyboardInterrupt:
                    # What runs got the signal, too, or ends by itself; nothing else is begun.
                    stopped.set()
                    raise
    except KeyboardInterrupt:
        print("Stopped. The same command goes on with what is not done yet.", file=sys.stderr)
        return 130
    if failures:
        print("\n".join(failures), file=sys.stderr)
        return 2
    missed = [f"{section.name}: {row.what}" for section in sections for row in section.rows if row.met is False]
    where = page.relative_to(REPOSITORY) if page.is_relative_to(REPOSITORY) else page
    if options.short:
        print(f"Written: {where}. Its goals are those of a full run: {len(missed)} are missed.")
        return 0
    print(f"Written: {where}." + (f" Missed: {'; '.join(missed)}." if missed else ""))
    return status(met=not missed)


def _failure(running: Future[None]) -> FailedError | None:
    """Wait for a group of sections; return why one of them was not made."""
    try:
        running.result()
    except FailedError as error:
        return error
    return None


if __name__ == "__main__":
    sys.exit(main())
