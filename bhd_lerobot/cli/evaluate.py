"""`bhd-eval`: compare brains on the same episodes."""

import sys
from collections.abc import Sequence

from rich.console import Console

from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import evaluate
from bhd_lerobot.evaluation.plan import print_plan
from bhd_lerobot.options.command import Program, run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-eval`; return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    keys = [argument.partition("=")[0] for argument in given]
    if "--brain.path" in keys and "--brain.type" not in keys:
        given.append("--brain.type=learned")  # nothing else is somewhere on the disk

    def program(config: EvalConfig) -> int:
        if config.plan:
            print_plan(config, Console())
            return 0
        return evaluate(config).exit_status

    return run(Program(EvalConfig, program), given)


if __name__ == "__main__":
    sys.exit(main())
