"""Runs the commands that results come from, each once, and remembers what they were and how long they took."""

import fcntl
import importlib
import json
import multiprocessing
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import reduction
from pathlib import Path
from threading import Event
from typing import Any

from benchmarks.results.provenance import digests, provenance

REPOSITORY = Path(__file__).resolve().parents[2]
_OWN = ".made_by_results"  # in a folder that was empty when a run took it

# Command lines, and the modules behind them: the tests of a checkout must not depend on what is in PATH.
_MODULES = {
    "bhd-record": "bhd_lerobot.cli.record",
    "bhd-train": "bhd_lerobot.cli.train",
    "bhd-eval": "bhd_lerobot.cli.evaluate",
    "bhd-data": "bhd_lerobot.cli.data.main",
}

# A start takes seconds, most of them to import PyTorch and LeRobot. A short run has more starts than it has anything
# else: its commands are forked from a process that has imported them. Not the benchmarks of processes and of MuJoCo's
# own renderer, which depend on what was started and imported before them.
_FORKS = multiprocessing.get_context("forkserver")
_FORKED = tuple(f"benchmarks.{name}" for name in ("evaluate", "loader", "navigate", "refusals"))
_IMPORTED = (
    *_MODULES.values(),
    *(f"bhd_lerobot.training.{name}train" for name in ("", "dagger.", "rl.")),
    *_FORKED,
    __name__,
)


class FailedError(Exception):
    """A command did not do what it was asked for."""


@dataclass(frozen=True)
class Ran:
    """A command that ended well, or that found a goal missed.

    Attributes:
        command: as a person would type it, in the repository.
        seconds: how long it took [s].
        status: its exit status.
        cpu_seconds: processor time, of all its processes and threads together [s].
        makes: what it made, as commands name it.
        configs: SHA-256 of the configurations that it named, and that those named, by their paths, when it began.
        made: when, where and with what, in words.
    """

    command: str
    seconds: float
    status: int
    cpu_seconds: float = 0.0
    makes: list[str] = field(default_factory=list)
    configs: dict[str, str] = field(default_factory=dict)
    made: str = ""


class Runner:
    """Runs commands in the repository and keeps a note of each that succeeded.

    A command that a note in the folder tells of is not run again: a run of hours that was stopped goes on where it was.
    It is run again if what it reads was made anew since, or if its configuration says something else now.

    Attributes:
        folder: where everything goes; one folder for each section.
        commands: what the present section ran, or had run before.
        chosen: the training seeds that are made; None for all.
        kept: folder of what was measured of each training seed.

    Args:
        folder: where everything goes.
        is_short: a short run, whose numbers are not to be quoted.
        stopped: once it is set, no further command is begun.
        chosen: as above.
        kept: as above; one in `folder` if nothing.
        lock: what `lock` returned, which commands hold as well.
    """

    def __init__(
        self,
        folder: Path,
        *,
        is_short: bool,
        stopped: Event | None = None,
        chosen: Sequence[int] | None = None,
        kept: Path | None = None,
        lock: int | None = None,
    ) -> None:
        self.folder, self.is_short, self._stopped = folder, is_short, stopped
        self._held = () if lock is None else (lock,)
        self.chosen, self.kept = chosen, folder / "trainings" if kept is None else kept
        self.commands: list[Ran] = []

    def size(self, full: int, short: int) -> int:
        """Return how much of something there is to be: in a full run, or in a short one."""
        return short if self.is_short else full

    def path(self, *parts: str) -> Path:
        """Return a path in the folder, relative to the repository if it lies there; its parent exists."""
        path = self.folder.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.relative_to(REPOSITORY) if path.is_relative_to(REPOSITORY) else path

    def run(
        self,
        name: str,
        arguments: Sequence[str],
        allowed: Sequence[int] = (0,),
        *,
        makes: Sequence[str] = (),
        resumes: Sequence[str] = (),
    ) -> Ran:
        """Run a command, or find that it was run.

        Args:
            name: what its note and its log are called.
            arguments: the command line: `bhd-…`, or `python -m …`.
            allowed: exit statuses that are no failure.
            makes: paths in the folder of what it makes and would not make anew; what is left there of a run that was
                stopped, or of another command, is removed.
            resumes: likewise of what it goes on with if it was stopped; removed only if what it reads was made anew, or
                its configuration was changed.

        Raises:
            FailedError: it failed; the message names its log.
        """
        command = shlex.join(arguments)
        if self._stopped is not None and self._stopped.is_set():
            raise FailedError(f"{command}\nwas not begun: the run was stopped.")
        note = REPOSITORY / self.path("notes", f"{name}.json")
        is_outdated = note.exists() and self._is_outdated(note)
        if note.exists() and not is_outdated:
            kept = _read(note)
            if kept.command == command:
                print(f"== {command}\n-- {name}: was run before, {kept.seconds:.0f} s", flush=True)
                self.commands.append(kept)
                return kept
        note.unlink(missing_ok=True)  # it tells of what is about to be made anew
        for made in (*makes, *(resumes if is_outdated else ())):
            if (left := REPOSITORY / self.path(made)).exists():
                shutil.rmtree(left)
        log = note.with_suffix(".log")
        print(f"== {command}\n   log: {log}", flush=True)
        started, configs, made_by = time.perf_counter(), digests([command], REPOSITORY), provenance(REPOSITORY)
        module, own = _module(arguments)
        if self.is_short and module in (*_MODULES.values(), *_FORKED):
            called = module if arguments[0] == "python" else arguments[0]
            status, cpu_seconds = _fork(module, [called, *own], log, self._held)
        else:
            start = [sys.executable, *(arguments[1:] if module is None else ("-m", module, *own))]
            status, cpu_seconds = _start(start, log, self._held)
        made = [str(self.path(one)) for one in (*makes, *resumes)]
        ran = Ran(command, time.perf_counter() - started, status, cpu_seconds, made, configs, made_by)
        if status not in allowed:
            tail = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:])
            raise FailedError(f"{command}\nended with status {status}. The end of {log}:\n{tail}")
        print(f"-- {name}: {ran.seconds:.0f} s", flush=True)
        note.write_text(json.dumps(asdict(ran), indent=1), encoding="utf-8")
        self.commands.append(ran)
        return ran

    def _is_outdated(self, note: Path) -> bool:
        """Whether something that the command of a note names was made, or configured otherwise, since."""
        kept, ended = _read(note), note.stat().st_mtime_ns
        command = kept.command
        if kept.configs != digests([command], REPOSITORY):
            return True
        newer = (one for one in (REPOSITORY / self.path("notes")).rglob("*.json") if one.stat().st_mtime_ns > ended)
        return any(re.search(rf"{re.escape(path)}(?![\w-])", command) for one in newer for path in _read(one).makes)

    def read(self, *parts: str) -> Any:
        """Return what a JSON file in the folder holds."""
        return json.loads((REPOSITORY / self.path(*parts)).read_text(encoding="utf-8"))


class Kept(Runner):
    """Runs nothing: what was measured of the training seeds lies beside the page, and the page says what else was run.

    Args:
        folder: the one that the commands on the page name.
        page: the page.
    """

    def __init__(self, folder: Path, page: Path) -> None:
        super().__init__(folder, is_short=False, chosen=(), kept=page.with_suffix(""))
        ran = re.finditer(
            r"^(.*)   # (\d+) s, (\d+) s of processor time$", page.read_text(encoding="utf-8"), re.MULTILINE
        )
        self._page, self._ran = page, {one[1]: (float(one[2]), float(one[3])) for one in ran}

    def run(self, name: str, arguments: Sequence[str], *_: Any, **__: Any) -> Ran:
        """Return what the page says of a command.

        Raises:
            FailedError: nothing.
        """
        command = shlex.join(arguments)
        if command not in self._ran:
            raise FailedError(f"{command}\n({name}) is not on {self._page}. Run it: leave --kept out.")
        seconds, cpu_seconds = self._ran[command]
        self.commands.append(Ran(command, seconds, 0, cpu_seconds))
        return self.commands[-1]


def lock(folder: Path) -> int:
    """Take a folder, which is made if it is not there; return the descriptor whose end gives it back.

    Two runs in one folder would remove what the other is about to make. A command that outlives a killed run holds it,
    too.

    Raises:
        FailedError: another run has it, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise FailedError(f"{folder} cannot be used as a folder: {error.strerror}. Name another: --folder.") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise FailedError(
            f"Results are being made in {folder} by another process, or by a command that a killed one left running. "
            "Wait until it ends, or name another folder: --folder."
        ) from None
    if not any(folder.iterdir()):
        (folder / _OWN).touch()
    return descriptor


def empty(folder: Path) -> None:
    """Remove all that is in a folder that was taken; links, not what they lead to.

    Raises:
        FailedError: the folder was not made, or was not empty, when a run took it first: some of that is not ours.
    """
    left = [one for one in folder.iterdir() if one.name != _OWN]
    if left and not (folder / _OWN).exists():
        raise FailedError(
            f"{folder} has no file {_OWN}: what it holds was not made by `make results`, or by an older version of it, "
            "and --fresh would remove it. Name another folder (--folder), or empty it yourself."
        )
    for one in left:
        shutil.rmtree(one) if one.is_dir() and not one.is_symlink() else one.unlink()


def _read(note: Path) -> Ran:
    return Ran(**json.loads(note.read_text(encoding="utf-8")))


# --- processes --------------------------------------------------------------------------------------------------------
# Each returns the exit status, and the processor time [s] of the command and of the processes that it waited for.
# Others may run beside it. What is held is left open in the command.


def _module(arguments: Sequence[str]) -> tuple[str | None, Sequence[str]]:
    """Return the module that a command line runs, None if it runs something else, and the module's own arguments."""
    first, *rest = arguments
    if first != "python":
        return _MODULES[first], rest
    return (rest[1], rest[2:]) if rest[:1] == ["-m"] else (None, rest)


def _start(arguments: Sequence[str], log: Path, held: Sequence[int]) -> tuple[int, float]:
    """Run a command in an interpreter of its own."""
    with log.open("w", encoding="utf-8") as file:
        process = subprocess.Popen(arguments, cwd=REPOSITORY, stdout=file, stderr=subprocess.STDOUT, pass_fds=held)
        _, ended, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(ended)
    return process.returncode, used.ru_utime + used.ru_stime


def _fork(module: str, arguments: Sequence[str], log: Path, held: Sequence[int]) -> tuple[int, float]:
    """Run the `main` of a module in a process that need not import it."""
    _FORKS.set_forkserver_preload(list(_IMPORTED))
    log.write_bytes(b"")  # here, where it is read
    used, sender = _FORKS.Pipe(duplex=False)
    own = [_Held(one) for one in held]
    process = _FORKS.Process(target=_forked, args=(module, arguments, log, own, sender))
    process.start()
    sender.close()
    process.join()
    assert process.exitcode is not None
    with used:
        try:
            return process.exitcode, float(used.recv()) if used.poll() else 0.0
        except EOFError:  # it was killed
            return process.exitcode, 0.0


class _Held:
    """A descriptor that a forked process gets."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def __reduce__(self) -> tuple[Any, ...]:
        return _detached, (reduction.DupFd(self.descriptor),)


def _detached(descriptor: Any) -> _Held:
    return _Held(descriptor.detach())


def _forked(module: str, arguments: Sequence[str], log: Path, held: Sequence[_Held], sender: Any) -> None:
    os.chdir(REPOSITORY)
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.argv = list(arguments)
    try:
        sys.exit(importlib.import_module(module).main())
    finally:
        both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        sender.send(sum(one.ru_utime + one.ru_stime for one in both))
