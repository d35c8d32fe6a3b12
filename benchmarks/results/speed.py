"""The sections about speed: the benchmarks of this folder, each beside its peers in one run."""

from collections.abc import Callable
from typing import Any

from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section

_MISSED = 1  # the exit status of a benchmark that found a goal missed


def benchmark(module: str, rows: Callable[[Any], list[Row]]) -> Callable[[Runner, Section], None]:
    """Return what runs a benchmark that writes JSON.

    Args:
        module: name of the benchmark.
        rows: makes rows of what it wrote.
    """

    def measure(run: Runner, section: Section) -> None:
        output = run.path("speed", f"{module}.json")
        run.run(f"speed_{module}", ["python", "-m", f"benchmarks.{module}", f"--json={output}"], allowed=(0, _MISSED))
        section.rows += rows(run.read("speed", f"{module}.json"))

    return measure
