"""How punctual and how safe a robot on the wall clock is: `make bench-realtime`.

Loops at 1 kHz take turns in blocks of some seconds, idle and under CPU load: the real robot, a C++ twin, a plain
Python loop, cyclictest, a negative control, the robot with a torch brain and video, and with its recorder stopped. Each
steps the physics of the same UR5. The table shows percentiles of the wake-up latency and of the duration of a tick, the
ratios of blocks that were neighbours in time, and the verdicts. Then come experiments: emergency stops, and processes
that are stopped and killed. Exits with 1 if a bound is missed.
"""

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.realtime.cases import CaseError
from benchmarks.realtime.checks import Check, exit_status, loop_checks
from benchmarks.realtime.harness import CONDITIONS, Progress, Run, measure, remarks
from benchmarks.realtime.load import LoadError
from benchmarks.realtime.machine import CpuTimes, describe, processors_awake
from benchmarks.realtime.parts import EXPERIMENTS, NAMES, PARTS, QUICK_SIZES, TITLES, Bench, Experiments, Sizes, expand
from benchmarks.realtime.robot_checks import (
    Pair,
    drop_check,
    loss_checks,
    plant_check,
    ratio_checks,
    recording_checks,
    stop_checks,
)
from benchmarks.realtime.table import console, measured_table, verdict_table

FULL = {"blocks": 6, "seconds": 10.0}
QUICK = {"blocks": 2, "seconds": 1.0}
SUBJECT = "bhd"
STAGE = (
    "All loops step the UR5 of the pick task at 1 kHz, with the objects of one scene on its table. The robot's arm "
    "moves on setpoints at 25 Hz, and its recorder runs; the C++ twin's and the plain loop's holds its posture."
)
DISTURBED = 0.05  # busy share of an idle machine above which its numbers are not to be trusted


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of the command line; a wrong one ends the program with a message and status 2."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.realtime", description=__doc__)
    parser.add_argument("--blocks", type=int, help=f"blocks for each case and condition (default {FULL['blocks']})")
    parser.add_argument("--seconds", type=float, help=f"length of a block [s] (default {FULL['seconds']:g})")
    parser.add_argument(
        "--only", nargs="+", metavar="PART", default=[*PARTS, *EXPERIMENTS], help=", ".join((*PARTS, *NAMES))
    )
    parser.add_argument("--skip", nargs="+", metavar="PART", default=[], help="parts to leave out, of the same")
    parser.add_argument("--conditions", nargs="+", metavar="CONDITION", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--quick", action="store_true", help="a short run; its numbers are not to be quoted")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured to a file")
    options = parser.parse_args(arguments)
    try:
        skipped = expand(options.skip)
        options.only = [name for name in expand(options.only) if name not in skipped]
    except ValueError as error:
        parser.error(str(error))
    if not options.only:
        parser.error("--skip leaves nothing of what --only says.")
    options.sizes = QUICK_SIZES if options.quick else Sizes()
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
    return bool(options.blocks >= FULL["blocks"] and options.seconds >= FULL["seconds"])


def report(
    run: Run, checks: Sequence[Check], options: argparse.Namespace, notes: Sequence[str], more: dict[str, Any]
) -> None:
    """Print the tables and the remarks, and write the JSON file if one was asked for."""
    out = console()
    if run.blocks:
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
            **more,
        }
        options.json.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")


def how_busy() -> str:
    """Return how busy others keep the machine, watched for a second before anything is measured."""
    before = CpuTimes.now()
    time.sleep(1.0)
    busy, stolen = CpuTimes.now().shares_since(before)
    text = f"Before the run other programs used {busy:.0%} of the processors, and the host took {stolen:.1%}."
    return text + (" THE MACHINE IS NOT IDLE, its numbers are disturbed!" if busy + stolen > DISTURBED else "")


def all_checks(
    run: Run, found: Experiments, reports: Sequence[Mapping[str, Any]], options: argparse.Namespace
) -> list[Check]:
    """Return all rows of the table of verdicts."""
    conditions = options.conditions
    left_out = dict.fromkeys((name for name in NAMES if name not in options.only), "left out with --only or --skip")
    why = left_out | run.missing | found.missing
    with_torch = Pair("torch brain and recorder writing video ÷ without", "torch", SUBJECT, 1.5)
    stopped = Pair("recorder stopped ÷ running", "stopped", "running", 1.2)
    return [
        *loop_checks(run.blocks, conditions, SUBJECT, TITLES[SUBJECT], why),
        *ratio_checks(with_torch, run.blocks, conditions, why),
        *recording_checks(reports, {SUBJECT: "without torch", "torch": "with torch and video"}, why),
        *stop_checks(found.stops, why.get("estop", "")),
        *loss_checks(found.losses, why.get("brain", "")),
        *ratio_checks(stopped, run.blocks, conditions, why),
        drop_check(found.drops, why.get("drops", "")),
        plant_check(found.plant, why.get("plant", "")),
    ]


def as_json(found: Experiments) -> dict[str, Any]:
    """Return what the experiments found as a mapping that JSON can hold."""
    losses = found.losses
    return {
        "estop": {" ".join(key): [asdict(stop) for stop in some.stops] for key, some in found.stops.items()},
        "brain": losses and {" ".join(key): [asdict(one) for one in some] for key, some in losses.by_kind.items()},
        "drops": found.drops and asdict(found.drops),
        "plant": found.plant and [asdict(stop) for stop in found.plant],
        "missing": found.missing,
    }


def main(arguments: Sequence[str]) -> int:
    """Measure and print; return 1 if a bound was missed, 2 if nothing could be measured."""
    options = parse_arguments(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    progress = Progress()
    names = [name for name in options.only if name in TITLES]
    absent: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="bhd-bench-") as folder, processors_awake() as awake:
        notes = [f"/dev/cpu_dma_latency: {awake}.", how_busy(), STAGE]
        started = CpuTimes.now()
        try:
            with ExitStack() as stack:
                bench = Bench(Path(folder), stack, progress)
                cases = bench.cases(names, absent)
                run = measure(cases, options.conditions, options.blocks, options.seconds, progress=progress)
            # One after the other, and the robots of the loops have ended: nothing else runs beside them.
            doing = [name for name in options.only if name in EXPERIMENTS]
            found = bench.experiments(doing, options.conditions, options.sizes)
        except LoadError as error:
            progress.finish()
            print(f"Nothing can be said: {error}", file=sys.stderr)
            return 2
        except CaseError as error:  # a robot that did not end as it should
            progress.finish()
            print(f"FAILED: {error}", file=sys.stderr)
            return 2
        progress.finish()
        notes.append(f"During the run the host took {CpuTimes.now().shares_since(started)[1]:.1%} of the processors.")
    run.missing = absent | run.missing
    checks = all_checks(run, found, bench.reports, options)
    report(run, checks, options, notes, {"reports": bench.reports, "experiments": as_json(found)})
    return exit_status(checks) if any(check.measured is not None for check in checks) else 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
