"""Whatever happens to a command, and whenever: nothing is lost, and its messages about that are true.

Every command that writes a dataset or a bag is killed, interrupted, or meets a full disk, before each of its changes of
the file system. Here some of them are tried; ``make sweep`` tries all.
"""

import json
import re
import shutil
import signal
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from tests.datasets.sweeps import faults
from tests.datasets.sweeps.faults import IS_FULL
from tests.datasets.sweeps.operations import NOTES, OPERATIONS, REFUSED, Operation, content, leftovers
from tests.forks import Fork

FAULTS = ("kill", "interrupt", "full")

# What messages say of the state in which a command leaves what it works on.
OLD = re.compile(
    r"(nothing was changed|is as it was|is unchanged|are unchanged|are as they were|was not touched|"
    r"no part was written|no dataset was made|"
    r"no bag was (written|left)|nothing was written there)(?! now)",
    re.IGNORECASE,
)
NEW = re.compile(r"had been (completed|made|pulled|merged|recovered)|are gone, and those behind|changed now")
DECIDED = "next command completes it"


@dataclass(frozen=True)
class Runner:
    """Runs commands, and keeps their output in a folder."""

    folder: Path

    def run(
        self,
        argv: list[str],
        watched: Path,
        *,
        place: str = "plain",
        target: Path = Path(),
        fault: str = "none",
        step: int = -1,
    ) -> tuple[int, str, int]:
        """Return exit status, output, and how many changes were seen, if it came to an end."""
        output, counted = self.folder / "output", self.folder / "steps"
        counted.unlink(missing_ok=True)
        run = partial(faults.run, place=place, target=target, kind=fault, step=step)
        status = Fork(run, argv, watched, counted, output=output).wait()
        steps = int(counted.read_text()) if counted.exists() else 0
        return status, output.read_text(encoding="utf-8", errors="replace"), steps


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("runner"))


def chosen(steps: int, offset: int, place: str) -> list[int]:
    """Return the changes before which something happens: all, or one of the last, which decide, seldom an early one.

    Which ones is another choice for each offset. At a place where the content is moved in file by file, between the
    decision and the end, it is every fourth of the last.
    """
    if IS_FULL:
        return list(range(1, steps + 1))
    early = [1 + offset * 5 % (2 * steps // 3)] if offset % 4 == 0 else []
    late = [steps - offset % 8] if place == "plain" else range(steps - 8 + offset % 4, steps + 1, 4)
    return sorted({*early, *(max(1, step) for step in late)})


CASES = [
    (operation, place)
    for operation in OPERATIONS
    for place in operation.places
    if IS_FULL or place == "plain" or operation.name in ("delete", "merge")
]


@pytest.mark.timeout(0 if IS_FULL else 900)  # all changes of one command: an hour on a busy machine
@pytest.mark.parametrize(("operation", "place"), CASES, ids=[f"{one.name}, {place}" for one, place in CASES])
def test_nothing_is_lost_and_messages_are_true(runner, tmp_path, operation, place):
    origin = tmp_path / "origin"
    origin.mkdir()
    operation.prepare(origin)
    folder = tmp_path / "f"

    def fresh() -> Path:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(origin, folder)
        return folder / operation.target

    target, argv = fresh(), operation.argv(folder)
    before = content(target)
    status, output, steps = runner.run(argv, folder, place=place, target=target)
    assert status == 0, output
    after = content(target)
    assert after not in ("nothing", "broken")
    assert leftovers(folder) == []
    assert steps > 5
    for number, fault in enumerate(FAULTS):
        for step in chosen(steps, len(FAULTS) * CASES.index((operation, place)) + number, place):
            target = fresh()
            status, output, _ = runner.run(argv, folder, place=place, target=target, fault=fault, step=step)
            where = f"{fault} before change {step} of {steps}: status {status}, {output!r}"
            assert "Traceback" not in output, where
            check_state(Outcome(operation, place, target, status, output), before, after, where)
            was_reported = status == 0 or bool(NEW.search(output))
            finish(runner, Outcome(operation, place, target, status, output), was_reported, after, where)
            for path in origin.rglob(NOTES):
                assert (folder / path.relative_to(origin)).read_text(encoding="utf-8") == "mine", where


@dataclass(frozen=True)
class Outcome:
    """What became of a command: its target, exit status, and what it printed."""

    operation: Operation
    place: str
    target: Path
    status: int
    output: str


def check_state(outcome: Outcome, before: str, after: str, where: str) -> None:
    """Check that the old or the new content is there, and that it is the one that the command speaks of."""
    name, output, found = outcome.operation.name, outcome.output, content(outcome.target)
    in_steps = name in ("record", "resume") or (name.startswith("repair") and not outcome.operation.is_refused)
    if outcome.status < 0 or DECIDED in output:  # the next command completes it; until then LeRobot mixes nothing
        if outcome.place == "no exchange" or name == "split into a folder" or outcome.place == "fixed":
            return
        assert found in (before, after, REFUSED) or in_steps, where
        return
    if in_steps:
        printed = len(re.findall(r"^saved \d+", output, re.MULTILINE))
        assert printed + 3 * (name != "record") <= saved_in(outcome.target), where
        return
    assert found in (before, after), where
    if OLD.search(output):
        assert found == before, where
    if NEW.search(output) or outcome.status == 0:
        assert found == after, where
    if outcome.status not in (0, -signal.SIGKILL):
        others = ("kept beside it", "exists already", "run it again to finish")
        assert OLD.search(output) or NEW.search(output) or any(one in output for one in others), where


def saved_in(root: Path) -> int:
    info = root / "meta/info.json"
    return json.loads(info.read_text(encoding="utf-8"))["total_episodes"] if info.exists() else 0


def finish(runner: Runner, outcome: Outcome, was_reported: bool, after: str, where: str) -> None:
    """Check that the same command again leads to the new content, once, and leaves nothing behind."""
    operation, target = outcome.operation, outcome.target
    folder = target.parent
    if not operation.is_new and operation.name != "split into a folder" and content(target) != after:
        status, output, _ = runner.run(["info", str(target)], folder)
        assert status == 0 or (status == 2 and operation.is_refused and "Traceback" not in output), (where, output)
    was_done = content(target) == after
    if not was_reported or operation.is_new:
        status, output, _ = runner.run(operation.argv(folder), folder, place=outcome.place, target=target)
        if "completed a change" in output or "nothing was changed now" in output:
            assert status in (0, operation.repeated), (where, output)  # completed now
        elif was_done and operation.repeated:
            assert (status, operation.says in output) == (operation.repeated, True), (where, output)
        else:
            assert status == 0, (where, output)
        assert leftovers(folder) == [], where
    assert content(target) == after, where
