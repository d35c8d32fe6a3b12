"""Runs the commands of a section, each once, and keeps what was measured."""

import fcntl
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks._turns import GOAL_MISSED
from benchmarks.results.provenance import provenance
from benchmarks.results.table import Table
from bhd_lerobot.datasets.storage.disk import Disk

REPOSITORY = Path(__file__).resolve().parents[2]


class FailedError(Exception):
    """A command failed, or the folder is in use."""


@dataclass(frozen=True)
class Ran:
    """A command that ended well, or that found a goal missed; with its times [s]."""

    command: str
    seconds: float
    cpu_seconds: float = 0.0
    made: str = ""

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Ran":
        """Read one that was kept; older files have further fields."""
        return cls(**{name: fields[name] for name in cls.__annotations__ if name in fields})


@dataclass(frozen=True)
class Part:
    """What was measured of a part of a section, once or of one training seed.

    Attributes:
        made: when, where and with what, in words.
        commands: what was run for it.
        measured: what the rows need, as JSON has it.
    """

    made: str
    commands: list[Ran]
    measured: Any = field(default_factory=dict)


def read_parts(kept: Path) -> dict[str, Part]:
    """Read what was measured, by the names of the parts with their training seeds; nothing if there is no file."""
    if not kept.exists():
        return {}
    parts = json.loads(kept.read_text(encoding="utf-8"))
    return {
        name: Part(one["made"], [Ran.read(ran) for ran in one["commands"]], one["measured"])
        for name, one in parts.items()
    }


def write_parts(kept: Path, parts: Mapping[str, Part]) -> None:
    """Write what was measured, a part in a line."""
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(asdict(one))}" for name, one in sorted(parts.items()))
    Disk().publish(kept, f"{{\n{lines}\n}}\n".encode())


class Runner:
    """Runs commands in the repository; one that is in the folder's list of what ran is not run again.

    Args:
        folder: where everything goes, relative to the repository or absolute.
        episodes: how many to record and to evaluate; as many as the commands say if None.

    Raises:
        FailedError: another process makes results in the folder.
    """

    def __init__(self, folder: Path, episodes: int | None = None) -> None:
        self.folder, self._episodes = folder, episodes
        self._here = REPOSITORY / folder
        self._here.mkdir(parents=True, exist_ok=True)
        # Two runs in one folder would remove what the other is about to make. Commands inherit the lock.
        self._lock = os.open(self._here, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise FailedError(
                f"Another process makes results in {folder}. Wait until it ends, or use --folder."
            ) from None
        self._list = self._here / "ran.jsonl"
        lines = self._list.read_text(encoding="utf-8").splitlines() if self._list.exists() else []
        self._ran = {one.command: one for one in (Ran.read(json.loads(line)) for line in lines)}

    def close(self) -> None:
        """Give the folder back."""
        os.close(self._lock)

    def make(self, section: Mapping[str, Any], name: str, table: Table, kept: Path) -> None:
        """Run the commands of a section; what was measured goes to the file `kept`.

        Raises:
            FailedError: a command failed.
        """
        parts: list[tuple[str, Any, dict[str, int]]] = [(name, section["once"], {})] if "once" in section else []
        parts += [
            (f"{part}_{seed}", spec, {"seed": seed})
            for part, spec in section.get("parts", {}).items()
            for seed in table.seeds
        ]
        for key, spec, words in parts:
            commands = [self.run(command) for command in table.commands(spec, **words)]
            measured = self.measure(table.fill(spec.get("measured", {}), **words))
            write_parts(kept, {**read_parts(kept), key: Part(provenance(REPOSITORY), commands, measured)})

    def run(self, text: str) -> Ran:
        """Run a command line, or find that it was run.

        Raises:
            FailedError: it failed; the message names its log.
        """
        arguments = shlex.split(text if self._episodes is None else _fewer(text, self._episodes))
        command = shlex.join(arguments)
        if command in self._ran:
            return self._ran[command]
        if "/dagger_" not in command:  # that resumes what it finds
            for left in self._outputs(arguments):
                shutil.rmtree(REPOSITORY / left, ignore_errors=True)
        log = self._here / "logs" / f"{len(self._ran):03d}.log"
        log.parent.mkdir(exist_ok=True)
        print(f"== {command}\n   log: {log}", flush=True)
        program, *options = arguments
        # Beside this interpreter: not what happens to be in PATH.
        start = sys.executable if program == "python" else Path(sys.executable).with_name(program)
        began, made = time.perf_counter(), provenance(REPOSITORY)
        with log.open("w", encoding="utf-8") as file:
            process = subprocess.Popen(
                [start, *options], cwd=REPOSITORY, stdout=file, stderr=file, pass_fds=(self._lock,)
            )
            _, ended, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(ended)
        if process.returncode not in (0, GOAL_MISSED):
            tail = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:])
            raise FailedError(f"{command}\nended with status {process.returncode}. The end of {log}:\n{tail}")
        ran = Ran(command, time.perf_counter() - began, used.ru_utime + used.ru_stime, made)
        print(f"   {ran.seconds:.0f} s", flush=True)
        with self._list.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(ran)) + "\n")
        self._ran[command] = ran
        return ran

    def _outputs(self, arguments: list[str]) -> list[Path]:
        """Return the folders that a command makes, of those in ours."""
        options = "--output_dir=|--output=" + ("|--dataset.root=" if arguments[0] == "bhd-record" else "")
        found = [Path(re.sub(f"^({options})", "", one)) for one in arguments if re.match(options, one)]
        found += [Path(after) for before, after in pairwise(arguments) if before == "--output"]
        return [path for path in found if path.is_relative_to(self.folder)]

    # --- what is kept: verbs of `measured`, with paths in the folder ---

    def measure(self, spec: Any) -> Any:
        """Return what the verbs of a part read, in the same mappings."""
        if isinstance(spec, Mapping):
            return {key: self.measure(one) for key, one in spec.items()}
        verb, *paths = spec.split()
        return getattr(self, f"_read_{verb}")(*paths)

    def _read_content(self, path: str) -> Any:
        return json.loads((self._here / path).read_text(encoding="utf-8"))

    def _read_brains(self, *paths: str) -> dict[str, Any]:
        """Return what evaluations sum up of each brain, and its score in every episode."""
        brains = {}
        for path in paths:
            results = self._read_content(f"{path}/results.json")
            for name, brain in results["brains"].items():
                scores = [round(float(one), 6) for one in _values(results, name, "score")]
                brains[name] = {**brain, "scores": scores}
        return brains

    def _read_successes(self, path: str) -> dict[str, list[bool]]:
        results = self._read_content(f"{path}/results.json")
        return {name: _values(results, name, "success") for name in results["brains"]}

    def _read_worlds(self, path: str) -> dict[str, Any]:
        places = sorted((self._here / path).glob("world_*"))
        return {one.name.removeprefix("world_"): {"brains": self._read_brains(f"{path}/{one.name}")} for one in places}

    def _read_perception(self, path: str) -> Any:
        (brain,) = self._read_content(f"{path}/results.json")["brains"].values()
        return brain["perception"]

    def _read_seconds(self, *paths: str) -> float:
        """Return how long the commands that made these folders took; of aggregation, how long its rounds took."""
        total = 0.0
        for path in paths:
            rounds = self._here / path / "rounds.json"
            (made,) = (
                one for one in self._ran.values() if self.folder / path in self._outputs(shlex.split(one.command))
            )
            last = self._read_content(f"{path}/rounds.json")["rounds"][-1] if rounds.exists() else {}
            total += float(last.get("seconds") or made.seconds)
        return total

    def _read_rounds(self, path: str) -> list[dict[str, Any]]:
        rounds = self._read_content(f"{path}/rounds.json")["rounds"]
        return [{key: row[key] for key in ("round", "episodes", "success")} for row in rounds]

    def _read_best(self, path: str) -> int | None:
        """Return the environment steps behind the best checkpoint; None if there is none."""
        best = self._here / path / "checkpoints/best"
        return int(best.resolve().name) if best.exists() else None

    def _read_rows(self, *paths: str) -> list[Any]:
        return [row for path in paths for row in self._read_content(path)["rows"]]


def _values(results: Any, brain: str, key: str) -> list[Any]:
    """Return a value of each episode of a brain, in the order of the episodes."""
    own = [result for result in results["episodes"] if result["brain"] == brain]
    return [one[key] for one in sorted(own, key=lambda one: int(one["episode"]))]


def _fewer(command: str, episodes: int) -> str:
    """Return a command that records or evaluates so many episodes."""
    if "/dagger_" in command:
        return f"{command} --expert_episodes={episodes} --episodes={episodes} --validation_episodes={episodes}"
    return re.sub(r"(--(?:dataset\.num_episodes|n_episodes|episodes)=)\d+", rf"\g<1>{episodes}", command)
