"""`bhd-monitor`: watch a robot that runs on the wall clock, from another terminal, and stop it."""

import sys
from collections.abc import Sequence

from bhd_lerobot.apps.monitor.monitor import PORT, monitor
from bhd_lerobot.options.command import Parser, exit_status


def _parser() -> Parser:
    parser = Parser(
        prog="bhd-monitor",
        description="Watch a robot that runs on the wall clock (--robot.clock=realtime). Keys: e or space triggers an "
        "emergency stop, immediately and without confirmation; q quits. Exit status: 0, 1 if the robot was killed or "
        "lost its brain meanwhile, 2 if there is no such robot.",
    )
    parser.add_argument("id", nargs="?", metavar="ID", help="robot.id of the robot; the only one that runs if left out")
    parser.add_argument("--once", action="store_true", help="print one snapshot and exit")
    parser.add_argument("--json", action="store_true", help="as JSON: one snapshot, or one a second with --seconds")
    parser.add_argument("--seconds", type=float, help="exit after this time [s]")
    parser.add_argument(
        "--3d", dest="in_3d", action="store_true", help="also show robot, scene and scan in 3-D, on a page in a browser"
    )
    parser.add_argument("--port", type=int, default=PORT, help=f"of the page; 0 for any free one; default {PORT}")
    parser.add_argument("--no-browser", action="store_true", help="with --3d, print the page's address only")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-monitor`; return the exit status."""
    return exit_status(lambda: monitor(_parser().parse(arguments)))


if __name__ == "__main__":
    sys.exit(main())
