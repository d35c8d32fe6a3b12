"""`bhd-doctor`: can this machine do what the package needs, and if not, what to do."""

import sys
from collections.abc import Sequence
from pathlib import Path

from bhd_lerobot.apps.doctor.doctor import RunTrials, examine_and_print
from bhd_lerobot.apps.doctor.trials import run_trials
from bhd_lerobot.options.command import Parser, Program, exit_status
from bhd_lerobot.options.command import run as run_program
from bhd_lerobot.options.terminal import Terminal


def _parser() -> Parser:
    parser = Parser(
        prog="bhd-doctor",
        description="Check this machine; print symptom, cause and remedy of each problem. Exit status 1: a problem. "
        "With --robot.type=… and its other options: print what is understood of an arm, and write --picture=FILE; with "
        "--identify: move its joints a little about home, and print the servos that it has.",
    )
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    parser.add_argument("--root", type=Path, help="folder for datasets, whose disk is checked; LeRobot's by default")
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="FOLDER",
        help="how late the robot of this dataset follows its commands, only that",
    )
    parser.add_argument("--realtime", action="store_true", help="latency test: how late a real-time process wakes up")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the latency test [s] (default: 10)")
    parser.add_argument("--rate", type=int, default=1000, help="wake-ups a second [Hz] (default: 1000)")
    return parser


def main(arguments: Sequence[str] | None = None, run: RunTrials = run_trials) -> int:
    """Run `bhd-doctor`; return the exit status: 0, 1 if there is a problem, 2 for wrong options."""
    given = sys.argv[1:] if arguments is None else arguments
    if any(one.startswith(("--robot", "--identify", "--picture")) for one in given):
        given = ["--identify=true" if one == "--identify" else one for one in given]
        import bhd_lerobot.registry  # noqa: F401  registers the robots
        from bhd_lerobot.apps.doctor.robot import RobotDescription, describe_robot

        return run_program(Program(RobotDescription, lambda config: describe_robot(config, Terminal())), given)
    return exit_status(lambda: examine_and_print(_parser().parse(arguments), run))


if __name__ == "__main__":
    sys.exit(main())
