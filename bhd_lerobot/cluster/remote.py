"""What runs first on a machine of a cluster. It travels by value and needs nothing but Python there.

So a machine that lacks a package, or has another version of it, can say so by itself; a class that came by name could
only fail to be imported.
"""

import contextlib
import hashlib
import importlib
import importlib.util
import io
import os
import pickle
import platform
import socket
import traceback
from importlib import metadata
from pathlib import Path
from typing import Any

_LINES, _WIDTH = 20, 300  # of what was printed during a call, that is passed on


def facts_of_machine(distributions: tuple[str, ...]) -> dict[str, str]:
    """Return what decides the bytes of an episode: versions by name; "not installed" where there is none."""
    facts = {"Python": platform.python_version(), "processor": platform.machine()}
    for name in distributions:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            facts[name] = "not installed"
    spec = importlib.util.find_spec("bhd_lerobot")
    if spec is None or spec.origin is None:
        return {**facts, "source of bhd_lerobot": "not installed"}
    folder, digest = Path(spec.origin).parent, hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".py", ".xml") and path.is_file():
            digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return {**facts, "source of bhd_lerobot": digest.hexdigest()[:12]}


class RemoteWorker:
    """A process that runs episodes. Its answers are dictionaries with `printed`, and `value` or `error`."""

    def __init__(self) -> None:
        self._server: Any = None

    def describe(self, distributions: tuple[str, ...]) -> dict[str, Any]:
        """Return where it runs, and what decides the bytes of its episodes."""
        return {"host": socket.gethostname(), "pid": os.getpid(), "facts": facts_of_machine(distributions)}

    def prepare(self, job: bytes, server: str) -> dict[str, Any]:
        """Get ready for a job; the value is the fingerprint of what this machine computes."""

        def start() -> str:
            self._server = None
            self._server = importlib.import_module(server).EpisodeServer(job)
            return str(self._server.fingerprint)

        return self._answer(start)

    def run(self, specs: list[tuple[int, int]]) -> dict[str, Any]:
        """Run episodes; the value is what the server returns."""
        return self._answer(lambda: self._server.run(specs))

    def _answer(self, call: Any) -> dict[str, Any]:
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            try:
                answer = {"value": call()}
            except Exception as error:
                answer = {"error": pack_error(error), "traceback": traceback.format_exc()}
        lines = [line[:_WIDTH] for line in output.getvalue().splitlines() if line.strip()]
        more = [f"… {len(lines) - _LINES} more lines"] if len(lines) > _LINES else []
        return {**answer, "printed": lines[:_LINES] + more}


def pack_error(error: Exception) -> bytes:
    """Return an exception as bytes; one that does not survive that becomes its text."""
    try:
        packed = pickle.dumps(error)
        pickle.loads(packed)
    except Exception:
        packed = pickle.dumps(RuntimeError(f"{type(error).__name__}: {error}"))
    return packed
