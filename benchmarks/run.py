"""Run every benchmark of this folder, each in a process of its own: `python -m benchmarks.run [NAME ...]`.

A benchmark is a file here that runs as a module and prints its table. It exits with 0 if it met its goals, with 3 if it
missed one, with 1 after an exception, and with 2 if its options are wrong or it could not measure anything here. Files
whose names start with an underscore are what benchmarks share. `realtime`, which has `make bench-realtime`, is run only
if it is named.
"""

import subprocess
import sys
import time
from pathlib import Path

from benchmarks._turns import GOAL_MISSED, status

FOLDER = Path(__file__).resolve().parent
NAMES = sorted(p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_") and p.stem != "run")


def main(chosen: list[str]) -> int:
    """Run the chosen benchmarks, or all.

    Returns:
        0; 1 if any of them failed; 2 for a name that is none; 3 if all ran, and any missed a goal.
    """
    unknown = sorted(set(chosen) - set(NAMES))
    if unknown:
        print(f"Unknown benchmark: {', '.join(unknown)}. Valid: {', '.join(NAMES)}.", file=sys.stderr)
        return 2
    failed, missed = [], []
    for name in chosen or [name for name in NAMES if name != "realtime"]:
        print(f"== {name}", flush=True)
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], cwd=FOLDER.parent, check=False)
        print(f"-- {name}: {time.perf_counter() - started:.1f} s, exit status {done.returncode}\n", flush=True)
        if done.returncode == GOAL_MISSED:
            missed.append(name)
        elif done.returncode != 0:
            failed.append(name)
    if missed:
        print(f"Goals missed: {', '.join(missed)}.", file=sys.stderr)
    if failed:
        print(f"Failed: {', '.join(failed)}.", file=sys.stderr)
        return 1
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
