"""`bhd-data`: everything that is done with a dataset between recording and training."""

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from bhd_lerobot.cli.start import INTERRUPTED, ending_when_unread, leaving_on_interrupt
from bhd_lerobot.datasets.storage.atomic import noting_what_is_done
from bhd_lerobot.errors import BhdError, unknown_name

# Modules, in the order of the help. What takes long to import, such as torch, is imported by a command when it runs.
COMMANDS = (
    "info",
    "timing",
    "check",
    "repair",
    "mark",
    "edit",
    "view",
    "push",
    "pull",
    "export",
    "import_bag",
)


class _Parser(argparse.ArgumentParser):
    """A parser that names the nearest command or option, which Python's own does from 3.14 on only."""

    def error(self, message: str) -> NoReturn:
        """End with status 2, the usage, and what is wrong."""
        if found := re.fullmatch(r"argument COMMAND: invalid choice: '(.*)' \(choose from (.*)\)", message):
            message = unknown_name("command", found[1], re.findall(r"[\w-]+", found[2]))
        super().error(message)

    def parse(self, arguments: Sequence[str] | None) -> argparse.Namespace:
        """Return what a command line asks for."""
        options, unknown = self.parse_known_args(arguments)
        if unknown:
            command: argparse.ArgumentParser = options.command_parser
            if not unknown[0].startswith("-"):
                command.error(f"there is an argument too many: {' '.join(unknown)}")
            valid = set(re.findall(r"(?<![\w-])--[\w-]+", command.format_help()))
            command.error(unknown_name("option", unknown[0].partition("=")[0], valid))
        return options


def _parser() -> _Parser:
    parser = _Parser(prog="bhd-data", description=__doc__.split(": ", 1)[1])
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands", required=True)
    for name in COMMANDS:
        importlib.import_module(f"bhd_lerobot.cli.data.{name}").add_to(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-data`; return the exit status."""
    with leaving_on_interrupt():
        parser = _parser()
    options = parser.parse(arguments)
    with noting_what_is_done() as done:
        return _carry_out(options, done)


def _carry_out(options: argparse.Namespace, done: Sequence[str]) -> int:
    """Run a command; return the exit status.

    Args:
        options: from the command line.
        done: what has come into force so far.
    """
    try:
        return ending_when_unread(lambda: options.run(options))
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except PermissionError as error:
        where = error.filename2 or error.filename
        print(f"error: {error.strerror}: {where}. Check the permissions of this path.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"Stopped; {', '.join(done) or options.stopped}.", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
