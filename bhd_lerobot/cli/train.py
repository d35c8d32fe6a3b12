"""`bhd-train`: a policy learns from a dataset, by trial and error, or in rounds from what an expert would have done."""

import importlib
import sys
from collections.abc import Sequence
from typing import Any

from bhd_lerobot.cli.start import keep_memory
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.options.parse import CommandLine


def algorithm_of(line: CommandLine) -> Any:
    """Return what a command line sets as `algorithm`, itself or in its file; None for learning from a dataset.

    Raises:
        ConfigError: there is no such file; said before what learns is imported, which takes seconds.
    """
    if "algorithm" in line.options or line.path is None:
        return line.options.get("algorithm")
    try:
        return line.file.get("algorithm")
    except ConfigError:
        if line.options.get("resume") is not True:
            raise
        return None  # a checkpoint's folder, or none, which is said where it is looked for


def _program(line: CommandLine) -> Program:
    """Return what learns as a command line asks. Only that is imported: stable-baselines3 is an extra."""
    algorithm = algorithm_of(line)
    part = "" if algorithm is None else "dagger." if algorithm == "dagger" else "rl."
    program: Program = importlib.import_module(f"bhd_lerobot.training.{part}train").PROGRAM
    return program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-train`; return the exit status: 0, 2 after an error, 130 after Ctrl-C."""
    if arguments is None:  # as a program of its own, not within another
        keep_memory()
    return run(_program, arguments, "train")


if __name__ == "__main__":
    sys.exit(main())
