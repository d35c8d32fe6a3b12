"""`bhd-data pull`: a dataset from the Hub, or from below a URL."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.cli.data.episode_list import parse_episodes, short
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.remote.listing import megabytes
from bhd_lerobot.datasets.remote.place import check_repo_id, is_url
from bhd_lerobot.errors import ConfigError, DatasetWriteError, TransferError, counted
from bhd_lerobot.hub.transfer import (
    again_line,
    folder_of,
    prompt_interrupt,
    quiet_bars,
    refuse_empty,
    remote_of,
    split_list,
    warn_of_folder,
)

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.pull import PullReport, Select


def add_to(commands: Commands) -> None:
    """Add `pull`."""
    help_text = "download a dataset from the Hub or from below a URL; from the Hub, also some episodes of it"
    command = add_command(commands, "pull", help_text, _run, names_dataset=False)
    command.set_defaults(too_many="Name the folder to download to with --root=FOLDER.")
    command.add_argument("source", nargs="?", help="user/name on the Hub, or a URL")
    command.add_argument("--repo_id", help="the name on the Hub, as an option")
    command.add_argument("--root", help="folder to download to; by default LeRobot's, for a name on the Hub")
    command.add_argument("--revision", help="branch, tag or commit; if left out, the one that stock LeRobot takes")
    command.add_argument("--episodes", help="only the files of these episodes, such as 0,3,5-9")
    command.add_argument("--outcome", help="only the files of episodes with this outcome, such as success")
    command.add_argument("--min_score", type=float, help="only the files of episodes with at least this score, 0 to 1")
    command.add_argument("--replace", action="store_true", help="replace another or a changed dataset in the folder")
    command.add_argument("--storage_options", help="options of the URL's file system, JSON")


def _run(options: argparse.Namespace) -> int:
    from bhd_lerobot.datasets.remote.pull import pull

    source, root = _places(options)
    again = again_line(options)
    kept = f"{root} is unchanged{'' if is_url(source) else ', and downloaded files are not fetched again'}."
    options.stopped = f"{kept} Continue with:\n  {again}"
    select = _selection(options)
    quiet_bars()
    with prompt_interrupt(options.stopped):
        remote = remote_of(source, options.storage_options, revision=options.revision)
        try:
            report = pull(remote, root, select=select, replace=options.replace)
        except (TransferError, DatasetWriteError) as error:
            raise type(error)(f"{error}\n{kept} When that is resolved, repeat:\n  {again}") from error
    print(format_report(report, source))
    return 1 if report.problem else 0


def format_report(report: "PullReport", source: str) -> str:
    """Return a report for a terminal."""
    lines = [f"{report.root}: {counted(report.total_episodes, 'episode')}"]
    if report.fetched:
        lines.append(
            f"  fetched {counted(len(report.fetched), 'file')}, {megabytes(report.fetched_bytes)}; "
            f"{report.kept} were there already"
        )
    else:
        lines.append(f"  nothing to fetch: all {report.kept} files are there")
    if report.episodes is not None:
        count = counted(len(report.episodes), "episode")
        lines[0] = f"{report.root}: {count} of {report.total_episodes}: {short(report.episodes)}"
        others = f"all {report.total_episodes}" if report.is_whole else "others, too"
        words = ["bhd-train", f"--dataset.repo_id={source}", f"--dataset.root={report.root}"]
        lines += [
            f"  a file holds many episodes: the downloaded ones hold {others}. Select yours when you load them:",
            f'    {shlex.join(words)} --dataset.episodes="{report.episodes}"',
        ]
    if report.problem:
        lines.append(f"  it is a copy of the remote dataset, which is not valid: {report.problem}")
    return "\n".join(lines)


def _selection(options: argparse.Namespace) -> "Select | None":
    """Return what chooses the episodes; None if all are wanted."""
    if options.episodes is None and options.outcome is None and options.min_score is None:
        return None
    episodes = None if options.episodes is None else sorted(set(parse_episodes(options.episodes)))
    if options.outcome is None and options.min_score is None:
        return lambda _: episodes or []
    from bhd_lerobot.datasets.format.state import load_state
    from bhd_lerobot.datasets.loader.selection import EpisodeFilter, StoredEpisodes

    wanted = EpisodeFilter(outcome=split_list(options.outcome) or "all", min_score=options.min_score)
    return lambda folder: wanted.select(StoredEpisodes.of(load_state(folder, files=False)), episodes)


def _places(options: argparse.Namespace) -> tuple[str, Path]:
    refuse_empty(options)
    source = options.source or options.repo_id
    if source is None or (options.source and options.repo_id):
        raise ConfigError("Give one source: bhd-data pull user/name, or bhd-data pull s3://bucket/dir --root=DIR.")
    if is_url(source):
        if options.root is None:
            raise ConfigError(f"Give the target: bhd-data pull {source} --root=DIR.")
        if options.revision is not None:
            raise ConfigError(f"{source} is a URL: it has no revisions. Leave --revision out.")
        return source, folder_of(options.root)
    check_repo_id(source)
    root = folder_of(options.root) if options.root else default_root(source)
    warn_of_folder(source, root)
    return source, root
