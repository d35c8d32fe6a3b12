"""`bhd-data timing`: how punctual a recording was."""

import argparse
import json
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, Terminal, add_command, root_of
from bhd_lerobot.datasets.timing.report import load_timing
from bhd_lerobot.datasets.timing.tables import print_timing
from bhd_lerobot.errors import ConfigError

_IMAGES = (".png", ".pdf", ".svg")


def add_to(commands: Commands) -> None:
    """Add `timing`."""
    help_text = "report the timing of a recording, in tables and an image; changes nothing"
    command = add_command(commands, "timing", help_text, _run)
    command.add_argument("--json", action="store_true", help="print everything as JSON")
    command.add_argument("--episode", metavar="NUMBER", type=int, help="only this episode")
    command.add_argument(
        "--output",
        metavar="FILE",
        type=Path,
        help="image, PNG, PDF or SVG; outputs/timing/NAME.png if left out, and none with --json",
    )


def _run(options: argparse.Namespace) -> int:
    root, episode, output, console = root_of(options), options.episode, options.output, Terminal()
    if output is not None and output.suffix.lower() not in _IMAGES:
        raise ConfigError(f"--output is {str(output)!r}; the image can be one of {', '.join(_IMAGES)}.")
    report = load_timing(root, episode)
    if options.json:
        print(json.dumps(report.values(), indent=1))
        if output is None:
            return 0
    else:
        print_timing(report, console)
    name = root.resolve().name + ("" if episode is None else f"_episode_{episode:06d}")
    output = output.expanduser() if output is not None else Path("outputs/timing") / f"{name}.png"
    from bhd_lerobot.datasets.timing.plots import draw_timing  # half a second to import, which `info` need not wait for

    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        draw_timing(report, output)
    except OSError as error:
        raise ConfigError(f"The image {output} cannot be written: {error.strerror}. Set --output.") from error
    if not options.json:
        console.print(f"Image: {output}")
    return 0
