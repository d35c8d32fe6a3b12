"""Run every benchmark of this folder, each in a process of its own: `python -m benchmarks.run [NAME ...]`.

A benchmark is a file here that runs as a module, prints its table and exits with 0. Files whose names start with an
underscore are what benchmarks share. `realtime` is run only if it is named: it has `make bench-realtime`.
"""

import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path(__file__).resolve().parent


def main(chosen: list[str]) -> int:
    """Run the chosen benchmarks, or all; return 0, or 1 when any of them failed, or 2 for a name that is none."""
    names = sorted(p.stem for p in FOLDER.glob("*.py") if not p.stem.startswith("_") and p.stem != "run")
    unknown = sorted(set(chosen) - set(names))
    if unknown:
        print(f"Unknown benchmark: {', '.join(unknown)}. Valid: {', '.join(names) or '(none)'}.", file=sys.stderr)
        return 2
    failed = []
    for name in chosen or [name for name in names if name != "realtime"]:
        print(f"== {name}", flush=True)
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], cwd=FOLDER.parent, check=False)
        print(f"-- {name}: {time.perf_counter() - started:.1f} s, exit status {done.returncode}\n", flush=True)
        if done.returncode != 0:
            failed.append(name)
    if failed:
        print(f"Failed: {', '.join(failed)}.", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
