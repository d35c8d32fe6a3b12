"""What runs on the machines of a cluster. It imports little, so that a machine with other versions can say so."""

import hashlib
import importlib
import os
import pickle
import platform
import socket
import traceback
from importlib import metadata
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import BhdError, ClusterError

_VERSIONS = ("ray", "lerobot_robot_bhd", "lerobot", "mujoco", "numpy", "scipy", "pin", "ruckig")


def facts_of_machine(more: tuple[str, ...] = ()) -> dict[str, str]:
    """Return what decides the bytes of an episode: versions by name, of some distributions more too."""
    facts = {"Python": platform.python_version(), "processor": platform.machine()}
    for name in (*_VERSIONS, *more):
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            facts[name] = "not installed"
    folder, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".py", ".xml") and path.is_file():
            digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return {**facts, "source of bhd_lerobot": digest.hexdigest()[:12]}


class RemoteWorker:
    """A process that runs episodes of one job after the other."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._server: Any = None

    def host(self) -> str:
        """Return where it runs."""
        return f"{socket.gethostname()}, process {os.getpid()}"

    def run(self, order: dict[str, Any], specs: list[tuple[int, int]]) -> dict[str, Any]:
        """Run episodes; return what the server returns, and as `error` what ended them early.

        Args:
            order: `number` of the run; `job`, a list of its reference; `server`, the module of the `EpisodeServer`;
                and what this machine must have: `facts`, those of the distributions `more` too, and `fingerprint`.
            specs: the episodes.
        """
        answer: dict[str, Any] = {"episodes": [], "times": []}
        try:
            if self._number != order["number"]:
                self._start(order)
            answer = self._server.run(specs)
        except Exception as error:
            answer["error"] = error
        if "error" in answer:
            first, last = specs[0][0], specs[-1][0]
            episodes = f"episode {first}" if first == last else f"episodes {first} to {last}"
            answer["error"] = _portable(answer["error"], f"It came up in {episodes} on {self.host()}.")
        return answer

    def _start(self, order: dict[str, Any]) -> None:
        """Get ready for a job."""
        import ray

        self._number, self._server = None, None
        here = facts_of_machine(order["more"])
        if wrong := [
            f"{name} {here[name]} there, {one} here" for name, one in order["facts"].items() if here[name] != one
        ]:
            raise ClusterError(
                f"A worker on {self.host()} would not record the same bytes: {'; '.join(wrong)}. Install the same on "
                "all machines, and start Ray there again."
            )
        self._server = importlib.import_module(order["server"]).EpisodeServer(ray.get(order["job"][0]))
        if self._server.fingerprint != order["fingerprint"]:
            raise ClusterError(
                f"A worker on {self.host()} would not record the same bytes: it has the same packages, but computes "
                "other numbers for the same episode than this machine. Its processor or its system's mathematics "
                "library differs. Use machines of one kind, this one among them."
            )
        self._number = order["number"]


def _portable(error: Exception, where: str) -> Exception:
    """Return an error that survives its way, with where it came up."""
    try:
        pickle.loads(pickle.dumps(error))
        sent = error
    except Exception:
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    sent.add_note(where)
    if not isinstance(error, BhdError):
        sent.add_note(f"There:\n{''.join(traceback.format_exception(error))}")
    return sent
