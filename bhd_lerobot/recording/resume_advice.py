"""What to do instead of resuming a dataset that was edited: commands that can be copied."""

import itertools
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.tasks.task import episode_seed

_REPLACED = ("--resume", "--dataset.root", "--dataset.num_episodes", "--seed")


def instead_of_resuming(config: RecordConfig, arguments: Sequence[str]) -> list[str]:
    """Return the commands that record what is missing into a new folder and merge it with what there is.

    The seed is one of which the dataset has no episode: with the recorded one the same episodes would be recorded
    again.
    """
    root = Path(config.dataset.root).expanduser() if config.dataset.root else default_root(config.dataset.repo_id)
    episodes = dataset_info(root).episodes
    known = {str(episode.metadata.get("seed")) for episode in episodes}
    split = config.split
    seed = next(
        seed
        for seed in itertools.count(config.seed + 1)
        if str(episode_seed(seed, 0, split)) not in known  # type: ignore[arg-type]
    )
    missing = config.dataset.num_episodes - len(episodes)
    more, whole = _free(root, "more"), _free(root, "all")
    record = [
        *("bhd-record", *_repeated(arguments), f"--dataset.root={more}"),
        *(f"--dataset.num_episodes={missing if missing > 0 else config.dataset.num_episodes}", f"--seed={seed}"),
    ]
    return [shlex.join(record), shlex.join(["bhd-data", "merge", str(root), str(more), "--output", str(whole)])]


def _repeated(arguments: Sequence[str]) -> Iterator[str]:
    """Yield a command line without the options that are given anew, written ``--key=value`` or ``--key value``."""
    rest = iter(arguments)
    for argument in rest:
        key, sign, _ = argument.partition("=")
        if key not in _REPLACED:
            yield argument
        elif not sign:
            next(rest, None)


def _free(root: Path, word: str) -> Path:
    """Return a place beside a dataset where nothing is."""
    names = itertools.chain([f"{root.name}_{word}"], (f"{root.name}_{word}{n}" for n in itertools.count(2)))
    return next(path for name in names if not (path := root.with_name(name)).exists())
