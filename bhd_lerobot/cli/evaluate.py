"""`bhd-eval`: compare brains on the same episodes."""

import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import loading
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.options.parse import CommandLine
from bhd_lerobot.options.terminal import Terminal


def program_of(line: CommandLine) -> Program:
    """Return what evaluates as a command line asks. Only that is imported: environments need LeRobot and torch."""
    if any(name.partition(".")[0] == "env" for name in (*line.options, *line.file)):
        from bhd_lerobot.evaluation.environment import PROGRAM

        return PROGRAM
    return Program(EvalConfig, _compare)


def _compare(config: EvalConfig) -> int:
    with loading():
        from bhd_lerobot.evaluation.evaluate import evaluate
        from bhd_lerobot.evaluation.plan import print_plan

    if config.plan:
        print_plan(config, Terminal())
        return 0
    return evaluate(config).exit_status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-eval`; return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    keys = [argument.partition("=")[0] for argument in given]
    if "--brain.path" in keys and "--brain.type" not in keys:
        given.append("--brain.type=learned")  # nothing else is somewhere on the disk
    return run(program_of, given, "eval")


if __name__ == "__main__":
    sys.exit(main())
