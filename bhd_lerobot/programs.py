"""Programs of this package in processes of their own."""

import os
import subprocess
import sys
from collections.abc import Sequence


def start_program(module: str, *arguments: object, descriptors: Sequence[int] = ()) -> "subprocess.Popen[bytes]":
    """Start a module as a program, which finds modules where this process does, and not in the present folder first.

    It has no input: what would ask a person fails instead. It is a session of its own: keys of the terminal, as Ctrl-C,
    are for this process, which ends it in order.

    Args:
        module: the module.
        arguments: of the program, as text.
        descriptors: of files that it inherits.
    """
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    folders = dict.fromkeys((*filter(None, before), *(folder or os.getcwd() for folder in sys.path)))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *map(str, arguments)],
        pass_fds=descriptors,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
    )
