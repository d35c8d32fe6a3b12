"""What every command line does alike: errors, exit statuses, Ctrl-C, a pipe that nothing reads, unknown options.

It imports nothing that takes time: a command begins with it.
"""

import argparse
import errno
import logging
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from bhd_lerobot.errors import BhdError, ConfigError, unknown_name

if TYPE_CHECKING:
    from bhd_lerobot.options.parse import CommandLine

FAILED = BhdError.exit_status
"""The exit status after an error with a message."""

INTERRUPTED = 128 + signal.SIGINT
"""The exit status after Ctrl-C."""

_REMEDIES = {
    **dict.fromkeys((errno.EACCES, errno.EPERM), "Check the permissions of this path."),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "Make room there, or name another folder."),
    errno.EROFS: "The file system is mounted read-only; name another folder.",
}


def exit_status(program: Callable[[], int | None], interrupted: str | Callable[[], str] = "Stopped.") -> int:
    """Run a program; return its status: 2 after an error of ours, without a traceback, and 130 after Ctrl-C."""
    # LeRobot looks for torchcodec as soon as there is a dataset's configuration, and prints 80 lines if it is broken.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    try:
        try:
            return program() or 0
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # a pipe that nothing reads shows now, not when Python ends
    except BhdError as error:
        print("\n  ".join([f"error: {error}", *getattr(error, "__notes__", ())]), file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        if not _is_unread():
            raise
        _give_output_up()
        return 128 + signal.SIGPIPE
    except OSError as error:
        if error.errno not in _REMEDIES:
            raise
        _give_output_up()
        where = error.filename2 or error.filename
        print(f"error: {error.strerror}{f': {where}' if where else ''}. {_REMEDIES[error.errno]}", file=sys.stderr)
        return FAILED
    except RuntimeError as error:
        if str(error) != "Could not determine home directory.":  # of `Path.expanduser`
            raise
        print("error: A path begins with ~ and the name of no user. Your own folder is ~/.", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(interrupted if isinstance(interrupted, str) else interrupted(), file=sys.stderr)
        return INTERRUPTED


def _is_unread() -> bool:
    """Return whether nothing reads standard output any more."""
    if sys.stdout is None:
        return False
    poll = select.poll()
    poll.register(sys.stdout, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _give_output_up() -> None:
    """Let Python not try again, when it ends, to write what standard output does not take."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@dataclass(frozen=True)
class Program:
    """What a command does with its configuration; `main` returns the exit status, where None is 0.

    Attributes:
        read: what makes the configuration of a command line; `parse` if None.
        interrupted: what is printed after Ctrl-C.
    """

    config_class: type
    main: Callable[[Any], int | None]
    read: "Callable[[CommandLine], Any] | None" = None
    interrupted: str = "Stopped."


def run(
    program: "Program | Callable[[CommandLine], Program]", arguments: Sequence[str] | None = None, command: str = ""
) -> int:
    """Run a program, or that which a command line chooses."""
    from bhd_lerobot.options.help import help_of
    from bhd_lerobot.options.parse import CommandLine, parse, read_line
    from bhd_lerobot.options.plugins import load_named, load_plugins
    from bhd_lerobot.options.shipped import shipped_names

    interrupted = "Stopped."

    def configured() -> int | None:
        nonlocal interrupted
        load_plugins()
        given = load_named(sys.argv[1:] if arguments is None else arguments)
        left = [argument for argument in given if argument not in ("-h", "--help")]
        choose = (lambda _: program) if isinstance(program, Program) else program
        try:
            line = read_line(left, command)
            chosen = choose(line)
        except ConfigError:
            if left == given:
                raise
            line = CommandLine({})  # help is printed whatever else is missing or wrong
            chosen = choose(line)
        interrupted = chosen.interrupted
        if left != given:
            types = re.findall(r"^--([\w.]+\.type)[=\n](\S+)$", "\n".join(left), re.MULTILINE)
            print(help_of(chosen.config_class, dict(types), shipped_names(command)))
            return 0
        return chosen.main(chosen.read(line) if chosen.read else parse(chosen.config_class, line))

    return exit_status(configured, lambda: interrupted)


class Parser(argparse.ArgumentParser):
    """A parser of options that names the nearest command or option."""

    def error(self, message: str) -> NoReturn:
        """End with status 2, the usage, and what is wrong."""
        if found := re.fullmatch(r"argument COMMAND: invalid choice: '(.*)' \(choose from (.*)\)", message):
            message = unknown_name("command", found[1], re.findall(r"[\w-]+", found[2]))
            message += " Its content is in `bhd-data info`." * (found[1] == "timing")
        super().error(message)

    def parse(self, arguments: Sequence[str] | None) -> argparse.Namespace:
        """Return what a command line asks for; end with status 2 if it has what is not known.

        `given` holds all words. Of a command whose default `entries_of` is the name of an option, what begins with
        ``--NAME.`` is in `entries`.
        """
        given = sys.argv[1:] if arguments is None else arguments
        entries = [one for one in given if re.match(r"--\w+\.", one)]  # argparse takes one with a space for positional
        options, unknown = self.parse_known_args([one for one in given if one not in entries])
        unknown += entries
        options.given = list(given)
        if entries_of := getattr(options, "entries_of", ""):
            options.entries = [argument for argument in unknown if argument.startswith(f"--{entries_of}.")]
            unknown = [argument for argument in unknown if argument not in options.entries]
        if unknown:
            command: argparse.ArgumentParser = getattr(options, "command_parser", self)
            if not unknown[0].startswith("-"):
                remedy = command.get_default("too_many")
                command.error(f"unexpected argument: {' '.join(unknown)}{f'. {remedy}' if remedy else ''}")
            valid = set(re.findall(r"(?<![\w-])--[\w-]+", command.format_help()))
            command.error(unknown_name("option", unknown[0].partition("=")[0], valid))
        return options
