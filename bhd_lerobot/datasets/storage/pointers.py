"""Files that were not fetched, and are whole elsewhere: Git keeps a pointer in their place, a few lines of text."""

import contextlib
from collections.abc import Iterable
from pathlib import Path

from bhd_lerobot.errors import DatasetError, brief

_KINDS = {b"version https://git-lfs.github.com/spec/": "git lfs pull", b"/annex/objects/": "git annex get ."}
_LONGEST = 1024  # bytes of a pointer


class NotFetchedError(DatasetError):
    """Files of a dataset were not fetched. That is no damage: nothing is to be recovered."""


def fetching(path: Path) -> str:
    """Return the command that fetches a file; empty if it is no pointer."""
    with contextlib.suppress(OSError):
        if path.is_file() and path.stat().st_size <= _LONGEST:
            with open(path, "rb") as file:
                content = file.read(_LONGEST)
            return next((command for begin, command in _KINDS.items() if content.startswith(begin)), "")
    return ""


def not_fetched(root: Path, paths: Iterable[Path]) -> NotFetchedError | None:
    """Return the error for the pointers among some files; None if there is none."""
    commands = {path: command for path in paths if (command := fetching(path))}
    if not commands:
        return None
    names = [path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path) for path in commands]
    what = "is a pointer" if len(names) == 1 else "are pointers"
    return NotFetchedError(
        f"{brief(names, 3)} in {root} {what} of Git, in the place of a file that was not fetched. Run "
        f"`{' and '.join(sorted(set(commands.values())))}` in that folder. Nothing was changed."
    )


def pulled_in_part(root: Path) -> NotFetchedError:
    """Return the error for a dataset of which only the files of some episodes were pulled."""
    return NotFetchedError(
        f"{root} holds some episodes of a dataset only: it was pulled with --episodes, --outcome or --min_score. "
        "`bhd-data pull` without them fetches the rest. Nothing was changed."
    )


def check_fetched(root: Path) -> None:
    """Check that no file of a dataset is a pointer."""
    files = (path for name in ("meta", "data", "videos") for path in sorted((root / name).rglob("*")))
    if error := not_fetched(root, files):
        raise error
