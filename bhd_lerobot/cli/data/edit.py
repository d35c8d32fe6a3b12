"""`bhd-data merge`, `filter`, `delete` and `split`: other datasets out of datasets."""

import argparse
import random
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.cli.data.episode_list import parse_episodes
from bhd_lerobot.datasets.edit.edits import EditReport, delete, keep, merge, split
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.format.summary import check_not_empty, dataset_info
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Whole, check_option


def add_to(commands: Commands) -> None:
    """Add the four commands."""
    text = "merge several datasets into a new one; they are not changed"
    command = add_command(commands, "merge", text, _merge, names_dataset=False)
    command.add_argument("roots", metavar="ROOT", nargs="+", type=Path, help="folders of the datasets, in order")
    command.add_argument("--output", metavar="FOLDER", type=Path, required=True, help="folder of the new dataset")

    text = "copy some episodes of a dataset to a new one; the original is not changed"
    command = add_command(commands, "filter", text, _filter)
    command.add_argument("--episodes", metavar="LIST", help="only among these episodes, for example 0,3,5-9")
    text = "only episodes with these outcomes, for example success or stuck,timeout; all is every outcome"
    command.add_argument("--outcome", metavar="NAMES", help=text)
    text = "only episodes with at least this score, 0 to 1"
    command.add_argument("--min_score", metavar="SCORE", type=float, help=text)
    command.add_argument("--exclude_late", action="store_true", help="leave out episodes with too many late frames")
    command.add_argument("--output", metavar="FOLDER", type=Path, required=True, help="folder of the new dataset")

    text = "remove episodes from a dataset, in place; the others are renumbered"
    command = add_command(commands, "delete", text, _delete)
    command.add_argument("--episodes", metavar="LIST", required=True, help="episodes, for example 0,3,5-9")

    text = "split a dataset into several new ones; the original is not changed"
    command = add_command(commands, "split", text, _split)
    command.add_argument(
        "--parts",
        metavar="PARTS",
        required=True,
        help="names and shares, such as train=0.8,val=0.2, or episodes: train=0-7;val=8,9",
    )
    command.add_argument(
        "--shuffle_seed", metavar="SEED", type=int, help="shuffle the episodes with this seed before the split"
    )
    command.add_argument("--output", metavar="FOLDER", type=Path, required=True, help="folder for the new datasets")


def _merge(options: argparse.Namespace) -> int:
    print(merge([root.expanduser() for root in options.roots], options.output.expanduser()))
    return 0


def _filter(options: argparse.Namespace) -> int:
    root = root_of(options)
    if options.episodes is None and options.outcome is None and options.min_score is None and not options.exclude_late:
        raise ConfigError(
            "filter needs a selection of episodes: --episodes 0,3,5-9, --outcome success, --min_score 0.5 or "
            "--exclude_late. With --outcome all it copies them all."
        )
    from bhd_lerobot.datasets.loader.selection import EpisodeFilter, StoredEpisodes  # seconds to import

    wanted = EpisodeFilter((options.outcome or "all").split(","), options.min_score, options.exclude_late)
    named = parse_episodes(options.episodes) if options.episodes is not None else None
    episodes = wanted.select(StoredEpisodes.of(load_state(root)), named)
    print(keep(root, episodes, options.output.expanduser()))
    return 0


def _delete(options: argparse.Namespace) -> int:
    def print_report(report: EditReport) -> None:
        gone = f"; episodes {options.episodes} were removed, and those after them have new numbers"
        print(f"{report}{'' if report.is_repeated else gone}", flush=True)

    delete(root_of(options), parse_episodes(options.episodes), print_report)
    return 0


def _split(options: argparse.Namespace) -> int:
    root = root_of(options)
    summary = dataset_info(root)
    check_not_empty(summary)
    parts = parts_of(options.parts, len(summary.episodes), options.shuffle_seed)
    for report in split(root, parts, options.output.expanduser()):
        print(report)
    return 0


def parts_of(text: str, total: int, shuffle_seed: int | None = None) -> dict[str, list[int]]:
    """Return the episodes of each part."""
    named: dict[str, str] = {}
    separator = ";" if ";" in text else ","
    for part in text.split(separator):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not name or "/" in name or name.startswith(".") or name in named:
            raise ConfigError(
                f"{part!r} in --parts={text} is not one name and its part. Write train=0.8,val=0.2 or "
                "'train=0-7;val=8,9', each name once."
            )
        if separator == "," and value in ("0", "1"):
            raise ConfigError(
                f"{part.strip()!r} in --parts={text} may be a share or an episode. Write {name}={value}.0 for the "
                f"share, {name}={value}-{value} for the episode."
            )
        named[name] = value
    if separator == ";" or not any("." in value for value in named.values()):
        return {name: parse_episodes(value) for name, value in named.items()}
    try:
        shares = {name: float(value) for name, value in named.items()}
    except ValueError:
        raise ConfigError(f"--parts={text} mixes shares and episodes, or has a share that is no number.") from None
    if not all(0 < share <= 1 for share in shares.values()) or sum(shares.values()) > 1 + 1e-9:
        raise ConfigError(f"The shares in --parts={text} must be above 0, and at most 1 together.")
    check_option("--shuffle_seed", shuffle_seed, Whole)
    order = list(range(total))
    if shuffle_seed is not None:
        random.Random(shuffle_seed).shuffle(order)
    ends, whole = [0], 0.0
    for share in shares.values():
        whole += share
        ends.append(round(whole * total))
    return {name: sorted(order[ends[i] : ends[i + 1]]) for i, name in enumerate(shares)}
