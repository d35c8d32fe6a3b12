"""How punctual the control loop is, beside a C++ twin in the same run: `make bench-realtime`.

Loops at 1 kHz, each with one physics step of the UR5 a tick, take turns in blocks of some seconds, idle and under CPU
load. The table shows percentiles of the wake-up latency and of the duration of a tick, the ratios to the C++ twin
(medians of the ratios of blocks that were neighbours in time) and the verdicts. Exits with 1 if a bound is missed.
"""

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.realtime.cases import Case, CaseError, cyclictest_case, python_case
from benchmarks.realtime.checks import Check, exit_status, loop_checks
from benchmarks.realtime.harness import CONDITIONS, Progress, Run, measure, remarks
from benchmarks.realtime.load import LoadError
from benchmarks.realtime.machine import CpuTimes, describe, processors_awake
from benchmarks.realtime.table import console, measured_table, verdict_table
from bhd_lerobot.errors import unknown_name

FULL = {"blocks": 6, "seconds": 10.0}
QUICK = {"blocks": 2, "seconds": 1.0}
TITLES = {
    "twin": "C++ twin",
    "python": "plain Python, own process",
    "cyclictest": "cyclictest",
    "thread": "Python beside a busy thread",
}
SUBJECT = "python"
DISTURBED = 0.05  # busy share of an idle machine above which its numbers are not to be trusted


def _twin(folder: Path) -> Case:
    from benchmarks.realtime.twin import twin_case

    return twin_case(folder)


MAKERS: dict[str, Callable[[Path], Case]] = {
    "twin": _twin,
    "python": lambda folder: python_case(folder, beside_busy_thread=False),
    "cyclictest": lambda _: cyclictest_case(),
    "thread": lambda folder: python_case(folder, beside_busy_thread=True),
}


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of the command line; a wrong one ends the program with a message and status 2."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.realtime", description=__doc__)
    parser.add_argument("--blocks", type=int, help=f"blocks for each case and condition (default {FULL['blocks']})")
    parser.add_argument("--seconds", type=float, help=f"length of a block [s] (default {FULL['seconds']:g})")
    parser.add_argument("--only", nargs="+", metavar="CASE", default=list(MAKERS), help=", ".join(MAKERS))
    parser.add_argument("--conditions", nargs="+", metavar="CONDITION", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--quick", action="store_true", help="a short run; its numbers are not to be quoted")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured to a file")
    options = parser.parse_args(arguments)
    for name in options.only:
        if name not in MAKERS:
            parser.error(unknown_name("case", name, MAKERS))
    defaults = QUICK if options.quick else FULL
    if options.blocks is None:
        options.blocks = int(defaults["blocks"])
    if options.seconds is None:
        options.seconds = defaults["seconds"]
    if options.blocks < 1:
        parser.error(f"--blocks is {options.blocks}; at least one block is needed.")
    if not 0.1 <= options.seconds <= 3600:
        parser.error(f"--seconds is {options.seconds:g}; a block takes between 0.1 and 3600 seconds.")
    return options


def quotable(options: argparse.Namespace) -> bool:
    """Tell whether a run is long enough for its numbers to be quoted."""
    return options.blocks >= FULL["blocks"] and options.seconds >= FULL["seconds"]


def report(run: Run, checks: Sequence[Check], options: argparse.Namespace, notes: Sequence[str]) -> None:
    """Print the tables and the remarks, and write the JSON file if one was asked for."""
    out = console()
    out.print(measured_table(run.blocks, TITLES))
    out.print(verdict_table(checks))
    for note in [*notes, *remarks(run, TITLES)]:
        loud = note.endswith("!")
        out.print(note, markup=False, highlight=False, style="bold red" if loud else None)
    if not quotable(options):
        wanted = f"{FULL['blocks']} blocks of {FULL['seconds']:g} s"
        out.print(f"A SHORT RUN: these numbers are not to be quoted; that takes {wanted}.", style="bold yellow")
    if options.json:
        contents = {
            "machine": describe(),
            "options": {"blocks": options.blocks, "seconds": options.seconds, "cases": options.only},
            "quotable": quotable(options),
            "notes": [*notes, *remarks(run, TITLES)],
            "missing": run.missing,
            "load_shares": run.load_shares,
            "blocks": [block.as_json() for block in run.blocks],
            "checks": [check.as_json() for check in checks],
        }
        options.json.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")


def how_busy() -> str:
    """Return how busy others keep the machine, watched for a second before anything is measured."""
    before = CpuTimes.now()
    time.sleep(1.0)
    busy, stolen = CpuTimes.now().shares_since(before)
    text = f"Before the run other programs used {busy:.0%} of the processors, and the host took {stolen:.1%}."
    return text + (" THE MACHINE IS NOT IDLE, its numbers are disturbed!" if busy + stolen > DISTURBED else "")


def main(arguments: Sequence[str]) -> int:
    """Measure and print; return 1 if a bound was missed, 2 if nothing could be measured."""
    options = parse_arguments(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    progress = Progress()
    with tempfile.TemporaryDirectory(prefix="bhd-bench-") as folder, processors_awake() as awake:
        notes = [f"/dev/cpu_dma_latency: {awake}.", how_busy()]
        cases: list[Case] = []
        absent = {}
        for name in dict.fromkeys(options.only):
            progress(f"preparing {TITLES[name]}")
            try:
                cases.append(MAKERS[name](Path(folder)))
            except CaseError as error:
                absent[name] = str(error)
                progress(f"LEFT OUT: {TITLES[name]}: {error}")
        started = CpuTimes.now()
        try:
            run = measure(cases, options.conditions, options.blocks, options.seconds, progress=progress)
        except LoadError as error:
            progress.finish()
            print(f"Nothing can be said: {error}", file=sys.stderr)
            return 2
        progress.finish()
        notes.append(f"During the run the host took {CpuTimes.now().shares_since(started)[1]:.1%} of the processors.")
    run.missing = absent | run.missing
    reasons = dict.fromkeys((name for name in MAKERS if name not in options.only), "left out with --only") | run.missing
    checks = loop_checks(run.blocks, options.conditions, SUBJECT, TITLES[SUBJECT], reasons)
    report(run, checks, options, notes)
    return exit_status(checks) if run.blocks else 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
