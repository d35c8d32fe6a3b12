"""`bhd-data timing`: how punctual a recording was."""

import argparse
import json
from pathlib import Path

from rich.console import Console

from bhd_lerobot.cli.data.command import Commands, Terminal, add_command, root_of
from bhd_lerobot.datasets.timing.report import load_timing
from bhd_lerobot.datasets.timing.tables import print_timing
from bhd_lerobot.errors import ConfigError

_IMAGES = (".png", ".pdf", ".svg")


def add_to(commands: Commands) -> None:
    """Add `timing`."""
    help_text = "how punctual a recording was: tables and an image; changes nothing"
    command = add_command(commands, "timing", help_text, _run)
    command.add_argument("--json", action="store_true", help="print everything as JSON")
    command.add_argument("--episode", metavar="NUMBER", type=int, help="this episode only")
    command.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        help="image, PNG, PDF or SVG; outputs/timing/NAME.png if nothing, and none with --json",
    )


def _run(options: argparse.Namespace) -> int:
    output = options.output.expanduser() if options.output is not None else None
    timing(root_of(options), Terminal(), options.episode, output, options.json)
    return 0


def timing(root: Path, console: Console, episode: int | None, output: Path | None, as_json: bool = False) -> None:
    """Print how punctual a recording was, and draw it.

    Args:
        root: the dataset.
        console: where it is printed.
        episode: the only episode that is wanted; all if None.
        output: where the image goes; `outputs/timing` if None, and nowhere with `as_json`.
        as_json: print plain values.

    Raises:
        DatasetError: there is no such dataset or episode, or it says nothing about its timing.
        ConfigError: the image cannot be written.
    """
    if output is not None and output.suffix.lower() not in _IMAGES:
        raise ConfigError(f"--output is {str(output)!r}; the image can be one of {', '.join(_IMAGES)}.")
    report = load_timing(root, episode)
    if as_json:
        print(json.dumps(report.values(), indent=1))
    else:
        print_timing(report, console)
    if output is None and as_json:
        return
    if output is None:
        name = root.resolve().name + ("" if episode is None else f"_episode_{episode:06d}")
        output = Path("outputs/timing") / f"{name}.png"
    from bhd_lerobot.datasets.timing.plots import draw_timing  # half a second to import, which `info` need not wait for

    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        draw_timing(report, output)
    except OSError as error:
        raise ConfigError(f"The image {output} cannot be written: {error.strerror}. Set --output.") from error
    if not as_json:
        console.print(f"Image: {output}")
