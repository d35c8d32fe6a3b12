"""What is measured of each training seed, in one sitting or in several.

Three trainings of a policy take longer than many a machine is free. With `--seeds 1` one of them is made, and the table
has it beside those that were made before: what was measured of each lies beside the page, in a file of its own.
"""

import hashlib
import json
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.results.provenance import digests
from benchmarks.results.runner import REPOSITORY, Ran, Runner
from benchmarks.results.section import Section
from bhd_lerobot.datasets.storage.disk import Disk

SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class Training:
    """What was measured of one training seed.

    Attributes:
        made: when, where and with what, in words.
        commands: what was run for it alone.
        configs: SHA-256 of what the configurations say that these name, and that those name, by their paths.
        measured: what the rows need, as JSON has it.
        networks: SHA-256 of names and shapes of all parameters, of each network that was trained; unknown if empty.
            No configuration tells that a policy's code has changed.
    """

    made: str
    commands: list[Ran]
    configs: dict[str, str]
    measured: Any
    networks: list[str] = field(default_factory=list)

    def is_like(self, other: "Training", own: int, others: int) -> bool:
        """Whether two trainings, of these seeds, differ in nothing else."""
        return (
            self.configs == other.configs
            and _recipe(self.commands, own) == _recipe(other.commands, others)
            and (self.networks == other.networks or not self.networks or not other.networks)
        )


def each(
    run: Runner, section: Section, name: str, seeds: Sequence[int], measure: Callable[[int], Any]
) -> dict[int, Any]:
    """Measure something for each training seed that is asked for; take the others from earlier runs.

    Of a short run only the first seed is made. A seed that was made by another recipe than the others, or never, is
    left out; where one is made now, the recipe is that of the configurations as they are.

    Args:
        run: runs the commands, and knows which seeds are asked for.
        section: is told when the others were made.
        name: of the files that keep what was measured.
        seeds: all seeds that there are.
        measure: runs the commands of a seed and returns what the rows need, which JSON can hold.

    Returns:
        what was measured, by seed, in the order of the seeds.
    """
    trainings, before = {}, len(run.commands)
    asked = [seed for seed in seeds[: 1 if run.is_short else None] if run.chosen is None or seed in run.chosen]
    for seed in asked:
        first = len(run.commands)
        measured = json.loads(json.dumps(measure(seed)))
        commands = run.commands[first:]
        configs = {path: digest for one in commands for path, digest in one.configs.items()}
        trainings[seed] = Training(commands[-1].made, commands, configs, measured, _networks(commands))
        if not run.is_short:
            run.kept.mkdir(parents=True, exist_ok=True)
            text = json.dumps(asdict(trainings[seed])) + "\n"
            Disk().publish(run.kept / f"{name}_{seed}.json", text.encode())
    for seed in () if run.is_short else sorted(set(seeds).difference(asked)):
        kept = _read(run.kept / f"{name}_{seed}.json")
        if kept is None:
            continue
        is_old = asked and kept.configs != digests([one.command for one in kept.commands], REPOSITORY)
        if is_old or any(not kept.is_like(other, seed, one) for one, other in trainings.items()):
            print(f"-- {name}: seed {seed} was made by another recipe and is left out; make it with --seeds {seed}")
            continue
        trainings[seed] = kept
        section.made_before.setdefault(kept.made, set()).add(seed)
    order = sorted(trainings)
    if name == section.name:
        shared = run.commands[:before]
        section.processor_s = {seed: _making([*shared, *trainings[seed].commands]) for seed in order}
    run.commands[before:] = [command for seed in order for command in trainings[seed].commands]
    return {seed: trainings[seed].measured for seed in order}


def _making(commands: Sequence[Ran]) -> float:
    """Return the processor time of the commands that recorded and trained, each of them once [s]."""
    once = {one.command: one.cpu_seconds for one in commands}
    making = ("bhd-record", "bhd-train", "bhd-data")
    return sum(seconds for command, seconds in once.items() if command.startswith(making))


def _read(path: Path) -> Training | None:
    if not path.exists():
        return None
    fields = json.loads(path.read_text(encoding="utf-8"))
    return Training(**fields | {"commands": [Ran(**one) for one in fields["commands"]]})


def _recipe(commands: Sequence[Ran], seed: int) -> list[str]:
    """Return commands without what tells one seed from another."""
    return [re.sub(rf"\b(seed[_=]){seed}\b", r"\1N", one.command) for one in commands]


def _networks(commands: Sequence[Ran]) -> list[str]:
    """Return the SHA-256 of names and shapes of the parameters in every checkpoint that commands made."""
    found = set()
    for folder in {one for command in commands for one in command.makes}:
        for path in (REPOSITORY / folder).glob("**/model.safetensors"):
            with path.open("rb") as file:  # the length of a JSON header, then that
                header = json.loads(file.read(*struct.unpack("<Q", file.read(8))))
            shapes = {name: one["shape"] for name, one in header.items() if name != "__metadata__"}
            found.add(hashlib.sha256(json.dumps(shapes, sort_keys=True).encode()).hexdigest())
    return sorted(found)
