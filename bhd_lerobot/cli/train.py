"""`bhd-train`: a policy learns from a dataset, or by trial and error."""

import importlib
import sys
from collections.abc import Sequence

from bhd_lerobot.training.rl.config import is_rl


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-train`; return the exit status: 0, 2 after an error, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    # Only what is needed is imported: stable-baselines3 is an extra.
    module = importlib.import_module(f"bhd_lerobot.training.{'rl.' if is_rl(arguments) else ''}train")
    return int(module.main(arguments))


if __name__ == "__main__":
    sys.exit(main())
