"""A copy of a dataset somewhere else, on the Hub or below a URL: what both have in common."""

import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bhd_lerobot.datasets.format.info import InfoError, checked_info, parse_object
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.hub import HubDataset
    from bhd_lerobot.datasets.remote.store import StoreDataset

CARD = "README.md"
PREVIEW = "preview.png"
SUBSET = "meta/bhd_subset.json"
"""Names the episodes of a dataset that were requested, if files of it are missing. It is never uploaded."""

MANIFEST = "bhd_files.json"
"""Checksums that version 0.2 wrote below a URL. It is never copied, and a push removes it."""

WORKERS = 4
"""Files that are moved at a time. With more of them the threads of a fast connection mostly wait for each other."""

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


@dataclass(frozen=True)
class RemoteFile:
    """A file of a remote dataset.

    Attributes:
        size: its bytes.
        digest: its checksum in hexadecimal; None if the place knows none.
        algorithm: how the checksum is made: `sha256`, or `git`, the name that git gives to the content.
    """

    size: int
    digest: str | None
    algorithm: str = "sha256"

    def matches(self, content: Path | bytes) -> bool:
        """Return whether a file on this machine, or its bytes, are this file; without a checksum, its size decides."""
        if isinstance(content, Path):
            if not content.is_file() or content.stat().st_size != self.size:
                return False
            return self.digest is None or self.digest == self._digest(content)
        return len(content) == self.size and self.digest in (None, self._hasher(content).hexdigest())

    @classmethod
    def of(cls, path: Path) -> "RemoteFile":
        """Return the size and checksum of a file on this machine."""
        file = cls(path.stat().st_size, None)
        return cls(file.size, file._digest(path))

    def _hasher(self, content: bytes = b"") -> Any:
        if self.algorithm == "git":
            return hashlib.sha1(b"blob %d\0" % self.size + content, usedforsecurity=False)
        return hashlib.sha256(content)

    def _digest(self, path: Path) -> str:
        with open(path, "rb", buffering=0) as file:
            return hashlib.file_digest(file, self._hasher).hexdigest()


@dataclass(frozen=True)
class Item:
    """A file that is to lie in a remote dataset: at `path`, with slashes; `size` is in bytes."""

    path: str
    content: Path | bytes
    size: int


type Remote = HubDataset | StoreDataset
"""A place that a dataset is copied to or from. Every method raises `TransferError` if the place refuses it.

Where `has_checksums` is on, files are listed with theirs, and an interrupted download can be resumed.
"""


def matching(contents: Mapping[str, Path | bytes], files: Mapping[str, RemoteFile]) -> set[str]:
    """Return which contents on this machine, by path, are the listed files of these paths."""
    with ThreadPoolExecutor(WORKERS) as pool:
        same = pool.map(lambda path: path in files and files[path].matches(contents[path]), contents)
        return {path for path, is_same in zip(contents, same, strict=True) if is_same}


def refuse_overlap(root: Path, remote: Remote) -> None:
    """Refuse to copy a dataset onto itself, or into itself: its files would be removed to be replaced."""
    if remote.folder is None:
        return
    here, there = root.expanduser().resolve(), remote.folder.expanduser().resolve()
    is_one = here.exists() and there.exists() and os.path.samefile(here, there)
    if is_one or here.is_relative_to(there) or there.is_relative_to(here):
        raise ConfigError(f"{remote.name} and {root} are the same folder, or one lies in the other. Name another one.")


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and not the name of a dataset on the Hub."""
    return "://" in place


def check_repo_id(name: str) -> str:
    """Return a name on the Hub if it is one."""
    if not _REPO_ID.fullmatch(name) or ".." in name or "--" in name or name.endswith((".git", ".", "-")):
        raise ConfigError(
            f"{name!r} is neither a name on the Hub, such as user/name, nor a URL, such as s3://bucket/folder or "
            "file:///folder."
        )
    return name


def is_recorded(path: str) -> bool:
    """Return whether a path is that of a data, video or episode-metadata file in LeRobot's layout."""
    return bool(_RECORDED.fullmatch(path))


_CHUNK_FILE = r"chunk-\d+/file-\d+"
_RECORDED = re.compile(rf"(data|meta/episodes)/{_CHUNK_FILE}\.parquet|videos/[^/]+/{_CHUNK_FILE}\.mp4")


def total(items: Iterable[Item | RemoteFile]) -> int:
    """Return the bytes of some files."""
    return sum(item.size for item in items)


def megabytes(size: int) -> str:
    """Return a number of bytes as text."""
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def listed(names: Iterable[str], at_most: int = 3) -> str:
    """Return some names as text, and how many more there are."""
    names = sorted(names)
    more = f" and {len(names) - at_most} more" if len(names) > at_most else ""
    return f"{', '.join(names[:at_most])}{more}"


def parse_info(content: bytes | None, place: str) -> dict[str, Any]:
    """Return the content of a `meta/info.json`, checked and with defaults; see `info.checked_info`."""
    if content is None:
        raise DatasetError(f"{place} is no LeRobot dataset any more: its {layout.INFO} is gone.")
    try:
        return checked_info(parse_object(content), place)
    except InfoError as error:
        raise DatasetError(f"{place} is no LeRobot dataset: in its {layout.INFO}, {error}.") from error
