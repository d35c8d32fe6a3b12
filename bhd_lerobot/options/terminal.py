"""Where a command prints what it was asked for."""

from rich.console import Console


class Terminal(Console):
    """Standard output. The program handles a pipe that is read no longer, as of ``| head -1``."""

    def on_broken_pipe(self) -> None:
        """Do not end with status 1, which has another meaning for some commands."""
        raise BrokenPipeError
