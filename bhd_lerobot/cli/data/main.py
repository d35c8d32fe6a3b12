"""`bhd-data`: everything that is done with a dataset between recording and training."""

import importlib
import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import leaving_on_interrupt
from bhd_lerobot.datasets.storage.atomic import noting_what_is_done
from bhd_lerobot.options.command import FAILED, Parser, exit_status
from bhd_lerobot.options.plugins import load_named

# Which module has a command, in the order of the help. What takes long to import, such as torch, is imported by a
# command when it runs.
MODULES = {
    "info": "info",
    "check": "check",
    "repair": "repair",
    "mark": "mark",
    **dict.fromkeys(("merge", "filter", "delete", "split"), "edit"),
    "view": "view",
    "push": "push",
    "pull": "pull",
    "export": "export",
    "import": "import_bag",
}


def _parser(command: str = "") -> Parser:
    """Return a parser of a command, and of others of its module; of all where there is no such command."""
    parser = Parser(prog="bhd-data", description=__doc__.split(": ", 1)[1])
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands", required=True)
    for name in [MODULES[command]] if command in MODULES else dict.fromkeys(MODULES.values()):
        importlib.import_module(f"bhd_lerobot.cli.data.{name}").add_to(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-data`; return the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    with leaving_on_interrupt():
        parser = _parser(words[0] if words else "")
    stopped = "nothing was changed"

    def run() -> int:
        nonlocal stopped
        given = load_named(words)
        if not given:
            parser.print_help(sys.stderr)
            return FAILED
        options = parser.parse(given)
        try:
            return int(options.run(options))
        finally:
            stopped = options.stopped  # a command may say more while it runs

    def interrupted() -> str:
        text = ", ".join(done) or stopped
        return f"Stopped; {text}" if "\n" in text else f"Stopped; {text}."  # a command on a line of its own ends there

    with noting_what_is_done() as done:
        return exit_status(run, interrupted)


if __name__ == "__main__":
    sys.exit(main())
