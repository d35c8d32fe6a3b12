"""A dataset must not name a file outside of it: its names and links are untrusted input."""

import contextlib
import os
import re
import shlex
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetError

LINKED_FOLDERS = "BHD_LINKED_FOLDERS"
"""Environment variable: folders, separated by colons, to which links in datasets may lead."""

_LONGEST = 200  # bytes: a part of a path has at most 255, and a suffix may be added
_FIELD = re.compile(r"\{\w+(?::0?\d{1,2}d)?\}")


def wrong_name(name: object) -> str:
    """Return why a name from a file cannot be a part of a path; nothing if it can."""
    if not isinstance(name, str):
        return f"{name!r} is no text"
    if name in ("", ".", "..") or "/" in name or "\\" in name:
        return f"{name!r} would lead to another folder"
    # Controls end a path (NUL) or change what a terminal shows; lone surrogates cannot be encoded.
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
        return f"{name!r} has characters that cannot be in a file's name"
    return f"{name[:40]!r}… is too long" if len(name.encode()) > _LONGEST else ""


def wrong_path(path: object) -> str:
    """Return why a relative path with slashes is none within a dataset; nothing if it is."""
    if not isinstance(path, str):
        return f"{path!r} is no text"
    wrong = next(filter(None, map(wrong_name, path.split("/"))), "")
    return f"{path!r} is no path within the dataset: {wrong}" if wrong else ""


def wrong_info(info: Mapping[str, Any]) -> str:
    """Return which name in an `info.json` leads out of the dataset; nothing if none does."""
    for key in info.get("features") or ():
        if why := wrong_name(key):
            return f"a feature's name {why}"
    for name in ("data_path", "video_path"):
        template = info.get(name)
        if template is None:
            continue
        if not isinstance(template, str):
            return f"{name} is {template!r} and no text"
        plain = _FIELD.sub("0", template)  # a field with a point or a bracket would read what is in Python's objects
        if "{" in plain or "}" in plain or wrong_path(plain):
            return f"{name} is {template!r}, which is no template of a path within the dataset"
    return ""


def check_inside(root: Path, path: Path) -> Path:
    """Return where a file of a dataset really lies: within it, or in a place that its links may lead to.

    These places are the folder `blobs` of the Hub's cache, if the dataset is a snapshot in that cache, and the folders
    that the environment variable `BHD_LINKED_FOLDERS` lists.
    """
    try:
        # Unlike Path.resolve, it accepts a link to itself; opening that fails later with a message.
        whole, target = Path(os.path.realpath(root)), Path(os.path.realpath(path))
    except ValueError as error:
        raise DatasetError(f"{root} names a file {str(path)!r}, which no file can be called ({error}).") from error
    if target.is_relative_to(whole) or any(target.is_relative_to(place) for place in _places(whole)):
        return target
    raise DatasetError(
        f"{path} is a link to {target}, outside of the dataset, and is not followed: it could be any file that you may "
        f"read. Make a copy with `cp -rL {shlex.quote(str(root))} COPY` and use that; or, if the link is yours, name "
        f"the folder that it leads to in the environment variable {LINKED_FOLDERS}."
    )


def check_links(root: Path) -> None:
    """Check that no link among the files of a dataset leads out of it."""
    pending = [*(root / name for name in ("meta", "data", "videos", "images")), *root.glob("tmp*")]
    seen: set[Path] = set()  # a link to a folder above would never end
    while pending:
        path = pending.pop()
        target = check_inside(root, path)
        if target in seen or not target.is_dir():
            continue
        seen.add(target)
        with contextlib.suppress(OSError), os.scandir(path) as entries:  # reading it fails later with a message
            pending += [Path(entry.path) for entry in entries if entry.is_symlink() or entry.is_dir()]


def _places(whole: Path) -> list[Path]:
    """Return the folders that links in a dataset may lead to besides itself."""
    declared = os.environ.get(LINKED_FOLDERS, "").split(os.pathsep)
    places = [Path(place).expanduser().resolve() for place in declared if place]
    # <cache>/datasets--user--name/snapshots/<commit>, whose files are links into <cache>/datasets--user--name/blobs.
    for folder in (whole, *whole.parents):
        if folder.parent.name == "snapshots" and folder.parent.parent.name.startswith("datasets--"):
            places.append(folder.parent.parent / "blobs")
    return places
