"""Runs the tests: those that keep the processors busy, then, apart from them, those of the wall clock, which wait.

    python -m tests [--workers=N] [ARGUMENTS OF PYTEST...]

Returns pytest's status; a part of which nothing was selected does not count where the other ran something.
"""

import os
import subprocess
import sys
import tempfile
from collections import Counter

import pytest

from tests.requirements import REASONS

BUSY, WAITING = "not wall_clock", "wall_clock"


def main(arguments: list[str]) -> int:
    workers = "0"
    if arguments and arguments[0].startswith("--workers="):
        workers = arguments.pop(0).partition("=")[2]
    shared = ("--numprocesses", workers, "--dist=worksteal") if workers != "0" else ()
    with tempfile.NamedTemporaryFile("r") as reasons:
        environment = {**os.environ, REASONS: reasons.name}
        statuses = []
        for part in (BUSY, WAITING):
            command = (sys.executable, "-m", "pytest", *shared, "-m", part, *arguments)
            statuses.append(subprocess.run(command, env=environment, check=False).returncode)
            if statuses[-1] == pytest.ExitCode.INTERRUPTED:
                break
        for reason, count in Counter(reasons.read().splitlines()).items():
            print(f"\033[1;31mNOT TESTED ({count} skipped): {reason}\033[0m", file=sys.stderr)
    ran = [status for status in statuses if status != pytest.ExitCode.NO_TESTS_COLLECTED]
    return max(ran, default=int(pytest.ExitCode.NO_TESTS_COLLECTED))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
