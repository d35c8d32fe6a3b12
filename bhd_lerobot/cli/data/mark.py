"""`bhd-data mark`: mark afterwards how an episode ended, or an intervention."""

import argparse

from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.cli.data.episode_list import parse_episodes
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import OUTCOMES


def add_to(commands: Commands) -> None:
    """Add `mark`."""
    text = "mark how episodes ended, or interventions; former marks stay in meta/edits.jsonl"
    command = add_command(commands, "mark", text, _run)
    command.add_argument("--episodes", metavar="LIST", required=True, help="episodes, for example 0,3,5-9")
    text = f"outcome of the episodes: {', '.join(OUTCOMES)}; for this package's tasks, only those that they have"
    command.add_argument("--outcome", metavar="NAME", help=text)
    text = "first and last frame of an intervention, such as 20-35"
    command.add_argument("--intervention", metavar="FIRST-LAST", help=text)
    command.add_argument("--clear_interventions", action="store_true", help="remove all interventions")
    command.add_argument("--note", metavar="TEXT", default="", help="reason, for the log")


def _run(options: argparse.Namespace) -> int:
    span: tuple[int, int] | None = None
    if options.intervention is not None:
        first, dash, last = options.intervention.partition("-")
        if not (first.isdecimal() and (last.isdecimal() or not dash)):
            raise ConfigError(
                f"--intervention is {options.intervention!r}; valid: FIRST-LAST in frames, such as 20-35."
            )
        span = int(first), int(last or first)
    marks = [options.outcome] * bool(options.outcome)
    marks += [f"an intervention in frames {span[0]} to {span[1]}"] if span is not None else []
    marks += ["no interventions"] * options.clear_interventions
    mark(
        root_of(options),
        parse_episodes(options.episodes),
        outcome=options.outcome,
        intervention=span,
        clear_interventions=options.clear_interventions,
        note=options.note,
        on_done=lambda report: print(f"{report}; episodes {options.episodes}: {', '.join(marks)}", flush=True),
    )
    return 0
