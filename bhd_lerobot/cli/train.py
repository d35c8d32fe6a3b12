"""`bhd-train`: a policy learns from a dataset, by trial and error, or in rounds from what an expert would have done."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bhd_lerobot.cli.start import keep_memory
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.rollout import configuration
from bhd_lerobot.training.rl.config import config_file


def algorithm_of(arguments: Sequence[str]) -> Any:
    """Return what a command line sets as `algorithm`, itself or in its file; None for learning from a dataset.

    What is wrong with the command line is left to the parser that reads it next.
    """
    try:
        overrides = configuration.read_overrides(arguments)
        if "algorithm" in overrides:
            return overrides["algorithm"]
        path = overrides.get(configuration.CONFIG_PATH)
        file = None if path is None else config_file(Path(str(path)))
        return None if file is None or file.suffix == ".json" else configuration.read_file(file).get("algorithm")
    except ConfigError:
        return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-train`; return the exit status: 0, 2 after an error, 130 after Ctrl-C."""
    if arguments is None:  # as a program of its own, not within another
        keep_memory()
        arguments = sys.argv[1:]
    algorithm = algorithm_of(arguments)
    # Only what is needed is imported: stable-baselines3 is an extra.
    part = "" if algorithm is None else "dagger." if algorithm == "dagger" else "rl."
    return int(importlib.import_module(f"bhd_lerobot.training.{part}train").main(arguments))


if __name__ == "__main__":
    sys.exit(main())
