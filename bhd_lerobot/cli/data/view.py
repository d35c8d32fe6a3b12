"""`bhd-data view`: look at a dataset in a browser."""

import argparse
import asyncio
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.errors import ConfigError, counted
from bhd_lerobot.options.terminal import Terminal

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
    try:
        from bhd_lerobot.apps.view import server
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
        if open_browser:
            server.open_browser(address)

    ended_by = asyncio.run(server.serve(dataset, port, ready))
    console.print("Ended.")
    return 128 + ended_by
