"""`bhd-data view`: look at a dataset in a browser."""

import argparse
import asyncio
import os
import sys
import webbrowser
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cli.data.command import Commands, Terminal, add_command, root_of
from bhd_lerobot.errors import ConfigError, counted

PORT = 8766


def add_to(commands: Commands) -> None:
    """Add `view`."""
    help_text = "show a dataset in a browser: videos, scan, plots, outcomes; Ctrl-C ends it"
    command = add_command(commands, "view", help_text, _run)
    command.add_argument(
        "--port", metavar="PORT", type=int, default=PORT, help=f"on 127.0.0.1; 0 for any free one; default {PORT}"
    )
    command.add_argument("--no-browser", action="store_true", help="print the address only")


def _run(options: argparse.Namespace) -> int:
    return view(root_of(options), Terminal(), port=options.port, open_browser=not options.no_browser)


def view(root: Path, console: Console, *, port: int = PORT, open_browser: bool = True) -> int:
    """Serve the page of a dataset until Ctrl-C or SIGTERM; return the exit status that states which."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port is {port}; it must be between 0 and 65535. 0 takes any that is free.")
    try:
        from bhd_lerobot.apps.view.server import serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "aiohttp":
            raise
        raise ConfigError("The page is served by aiohttp, which is not installed: pip install aiohttp") from error
    from bhd_lerobot.apps.view.dataset import ViewedDataset

    dataset = ViewedDataset(root)

    def ready(address: str) -> None:
        episodes = dataset.state.num_episodes
        told = counted(episodes, "episode") if episodes else "empty, no episodes yet,"
        console.print(f"{escape(str(root))}: {told} at {address}", soft_wrap=True, highlight=False)
        console.print("Ctrl-C ends it.")
        if open_browser and _has_display():
            webbrowser.open(address)

    ended_by = asyncio.run(serve(dataset, port, ready))
    console.print("Ended.")
    return 128 + ended_by


def _has_display() -> bool:
    """Tell whether a browser would come up in a window; a text browser would take this terminal."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
