"""What every command line does alike: errors, exit statuses, Ctrl-C, a pipe that nobody reads, unknown options.

It imports nothing that takes time: a command begins with it.
"""

import argparse
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from bhd_lerobot.errors import BhdError, unknown_name

FAILED = 2
"""The exit status after an error with a message."""

INTERRUPTED = 128 + signal.SIGINT
"""The exit status after Ctrl-C."""


def exit_status(program: Callable[[], int | None], interrupted: str | Callable[[], str] = "Stopped.") -> int:
    """Run a program; return its exit status.

    An error of this package, or a missing permission, is printed without a traceback and gives status 2. Ctrl-C gives
    130, and the status is that of other programs where nobody reads what is printed, as of ``| head -1``.

    Args:
        program: returns its exit status; None is 0.
        interrupted: what is printed after Ctrl-C.
    """
    try:
        try:
            return program() or 0
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # a pipe that nobody reads shows now, not when Python ends
    except BhdError as error:
        print("\n  ".join([f"error: {error}", *getattr(error, "__notes__", ())]), file=sys.stderr)
        return FAILED
    except BrokenPipeError:
        if not _is_unread():
            raise
        return 128 + signal.SIGPIPE
    except PermissionError as error:
        where = error.filename2 or error.filename
        print(f"error: {error.strerror}: {where}. Check the permissions of this path.", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(interrupted if isinstance(interrupted, str) else interrupted(), file=sys.stderr)
        return INTERRUPTED


def _is_unread() -> bool:
    """Return whether nobody reads standard output any more; then Python does not try to write it when it ends."""
    if sys.stdout is None:
        return False
    poll = select.poll()
    poll.register(sys.stdout, 0)
    if not any(events & select.POLLERR for _, events in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Return whether a command line asks for help."""
    return any(argument in ("-h", "--help") for argument in arguments)


class Parser(argparse.ArgumentParser):
    """A parser of options that names the nearest command or option."""

    def error(self, message: str) -> NoReturn:
        """End with status 2, the usage, and what is wrong."""
        if found := re.fullmatch(r"argument COMMAND: invalid choice: '(.*)' \(choose from (.*)\)", message):
            message = unknown_name("command", found[1], re.findall(r"[\w-]+", found[2]))
        super().error(message)

    def parse(self, arguments: Sequence[str] | None) -> argparse.Namespace:
        """Return what a command line asks for."""
        options, unknown = self.parse_known_args(arguments)
        if unknown:
            command: argparse.ArgumentParser = getattr(options, "command_parser", self)
            if not unknown[0].startswith("-"):
                command.error(f"there is an argument too many: {' '.join(unknown)}")
            valid = set(re.findall(r"(?<![\w-])--[\w-]+", command.format_help()))
            command.error(unknown_name("option", unknown[0].partition("=")[0], valid))
        return options
