"""A process that forks the victims of SIGKILL."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any


class KillServer:
    """The process that forks the victims."""

    def __init__(self, module: str = "tests.datasets.kill_server") -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        )

    def start(self, job: dict[str, Any]) -> int:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return int(self.process.stdout.readline())

    def end(self) -> int:
        assert self.process.stdout is not None
        return int(self.process.stdout.readline())

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def edit(self, name: str, roots: list[Path], die_at: int, **values: Any) -> bool:
        """Edit a dataset, with SIGKILL before a change of the disk; return whether it came to that."""
        self.start({"edit": name, "roots": [str(root) for root in roots], "die_at": die_at, **values})
        status = self.end()
        assert status in (0, -signal.SIGKILL, signal.SIGKILL), status
        return status != 0
