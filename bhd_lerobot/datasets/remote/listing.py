"""A copy of a dataset somewhere else, on the Hub or below a URL: what both have in common.

A `Remote` lists its files with a checksum each, so that a transfer that is repeated moves only what differs.
"""

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from bhd_lerobot.datasets.format.info import InfoError, checked_info, parse_object
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, DatasetError, TransferError

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.local import LocalDataset

CARD = "README.md"
PREVIEW = "preview.png"
SUBSET = "meta/bhd_subset.json"
"""Names the episodes of a dataset that were requested, if files of it are missing. It is never uploaded."""

MANIFEST = "bhd_files.json"
"""Size and checksum of every file, beside a dataset below a URL; no part of the dataset."""

LISTED = "xxh128"
"""How the checksums in the manifest are made."""

WORKERS = 4
"""Files that are moved at a time. With more of them the threads of a fast connection mostly wait for each other."""

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


@dataclass(frozen=True)
class RemoteFile:
    """A file of a remote dataset.

    Attributes:
        size: its bytes.
        digest: its checksum in hexadecimal; None if the place knows none.
        algorithm: how the checksum is made: `sha256`; `git`, the name that git gives to the content; or `xxh128`, which
            takes a tenth of the time and finds damage, though no malice: of files in the manifest of a push.
    """

    size: int
    digest: str | None
    algorithm: str = "sha256"

    def matches(self, content: Path | bytes) -> bool:
        """Return whether a file on this machine, or its bytes, are this file; without a checksum, its size decides."""
        if isinstance(content, Path) and not content.is_file():
            return False
        if self.size != (len(content) if isinstance(content, bytes) else content.stat().st_size):
            return False
        return self.digest is None or self.digest == digest(content, self.size, self.algorithm)


@dataclass(frozen=True)
class Item:
    """A file that is to lie in a remote dataset.

    Attributes:
        path: where, relative to the dataset, with slashes.
        content: the file on this machine, or its bytes.
        size: its bytes.
    """

    path: str
    content: Path | bytes
    size: int


class Remote(Protocol):
    """A place that a dataset is copied to or from. Every method raises `TransferError` if the place refuses it.

    Attributes:
        name: what the user calls it.
        folder: where it lies, if that is on this machine.
    """

    name: str
    folder: Path | None

    def files(self) -> dict[str, RemoteFile]:
        """Return all files by path; none if there is nothing yet."""

    def read(self, path: str) -> bytes | None:
        """Return the content of a small file; None if there is none.

        Of `meta/info.json`, after a push that did not end, the one from before that push if it is known.
        """

    def verified(self, paths: Sequence[str]) -> dict[str, RemoteFile]:
        """Return listed files with the checksum of their content, which is read; none if the place itself makes it."""

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Copy files into a folder, each of which is then the listed one, to the last byte.

        Raises:
            TransferError: not all of them arrived, or one differs; those that arrived intact are kept.
        """

    def send(self, source: "LocalDataset", items: Sequence[Item], deleted: Sequence[str]) -> None:
        """Put files there and remove others, so that a reader never takes a part for the whole.

        Args:
            source: the dataset, which is checked for changes before anything becomes visible.
            items: what is to be written.
            deleted: paths that are to be removed.

        Raises:
            DatasetError: the dataset was changed meanwhile.
            TransferError: not all was sent; what was need not be sent again.
        """


def digest(content: Path | bytes | Any, size: int, algorithm: str) -> str:
    """Return the checksum of a file, of bytes or of an open file of that size; see `RemoteFile`."""

    def hasher() -> Any:
        if algorithm == "git":
            return hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
        if algorithm == LISTED:
            import xxhash

            return xxhash.xxh3_128()
        return hashlib.sha256()

    if isinstance(content, Path):
        with open(content, "rb", buffering=0) as file:
            return str(hashlib.file_digest(file, hasher).hexdigest())
    return str(hashlib.file_digest(BytesIO(content) if isinstance(content, bytes) else content, hasher).hexdigest())


def run_all[T](work: Callable[[T], None], items: Sequence[T], workers: int = WORKERS) -> None:
    """Do something for every item, in threads; none is begun after one has failed.

    Raises:
        Exception: of the first that failed.
    """
    with ThreadPoolExecutor(workers) as pool:
        try:
            for future in as_completed([pool.submit(work, item) for item in items]):
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def refuse_overlap(root: Path, remote: Remote) -> None:
    """Refuse to copy a dataset onto itself, or into itself: its files would be removed to be replaced.

    Raises:
        ConfigError: the two folders are one, or one lies in the other.
    """
    if remote.folder is None:
        return
    here, there = root.expanduser().resolve(), remote.folder.expanduser().resolve()
    is_one = here.exists() and there.exists() and os.path.samefile(here, there)
    if is_one or here.is_relative_to(there) or there.is_relative_to(here):
        raise ConfigError(f"{remote.name} and {root} are the same folder, or one lies in the other. Name another one.")


def refuse_damaged(path: Path, file: RemoteFile, place: str, name: str) -> None:
    """Remove a file that is not the listed one, and say so.

    Raises:
        TransferError: it is not.
    """
    if not file.matches(path):
        path.unlink(missing_ok=True)
        raise TransferError(
            f"Could not download {place}: {name} differs from what is listed. It was changed meanwhile, or damaged on "
            "the way."
        )


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and not the name of a dataset on the Hub."""
    return "://" in place


def check_repo_id(name: str) -> str:
    """Return a name on the Hub if it is one.

    Raises:
        ConfigError: it is not of the form user/name.
    """
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
    """Return a number of bytes in words."""
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def listed(names: Iterable[str], at_most: int = 3) -> str:
    """Return some names in words, and how many more there are."""
    names = sorted(names)
    more = f" and {len(names) - at_most} more" if len(names) > at_most else ""
    return f"{', '.join(names[:at_most])}{more}"


def largest_first(paths: Iterable[str], files: Mapping[str, Item | RemoteFile]) -> list[str]:
    """Return paths so that no large file is left for the end, when the other threads have nothing to do."""
    return sorted(paths, key=lambda path: (-files[path].size, path))


def parse_info(content: bytes | None, place: str) -> dict[str, Any]:
    """Return the content of a `meta/info.json`, checked and with defaults; see `info.checked_info`.

    Args:
        content: the file; None if it is not there any more.
        place: whose it is, for messages.

    Raises:
        DatasetError: it is none, or that of another format; the message has the reason.
    """
    if content is None:
        raise DatasetError(f"{place} is no LeRobot dataset any more: its {layout.INFO} is gone.")
    try:
        return checked_info(parse_object(content), place)
    except InfoError as error:
        raise DatasetError(f"{place} is no LeRobot dataset: in its {layout.INFO}, {error}.") from error
