"""Files of a dataset on the Hub or below a URL: how they are named, compared and printed."""

import hashlib
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.info import InfoError, checked_info, parse_object
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError

CARD = "README.md"
PREVIEW = "preview.png"
_CHUNK_FILE = r"chunk-\d+/file-\d+"
_RECORDED = re.compile(rf"(data|meta/episodes)/{_CHUNK_FILE}\.parquet|videos/[^/]+/{_CHUNK_FILE}\.mp4")


@dataclass(frozen=True)
class RemoteFile:
    """A file: its bytes, and on the Hub the SHA-256 of its content or, if it is small, git's name of it."""

    size: int
    digest: str | None = None

    def matches(self, path: Path) -> bool:
        """Return whether a file on this machine is this file; without a digest, its size decides."""
        if not path.is_file() or path.stat().st_size != self.size or self.digest is None:
            return path.is_file() and path.stat().st_size == self.size
        git = hashlib.sha1(b"blob %d\0" % self.size, usedforsecurity=False)
        hasher = git if len(self.digest) == 2 * git.digest_size else hashlib.sha256()
        with open(path, "rb", buffering=0) as file:
            return hashlib.file_digest(file, lambda: hasher).hexdigest() == self.digest


def matching(paths: Mapping[str, Path], files: Mapping[str, RemoteFile]) -> set[str]:
    """Return which files on this machine are the remote files of the same names."""
    with ThreadPoolExecutor(4) as pool:
        same = pool.map(lambda name: name in files and files[name].matches(paths[name]), paths)
        return {name for name, is_same in zip(paths, same, strict=True) if is_same}


def is_recorded(path: str) -> bool:
    """Return whether a path is that of a data, video or episode-metadata file in LeRobot's layout."""
    return bool(_RECORDED.fullmatch(path))


def megabytes(size: int) -> str:
    """Return a number of bytes as text."""
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def parse_info(content: bytes | None, place: str) -> dict[str, Any]:
    """Return the content of a `meta/info.json`, checked and with defaults; see `info.checked_info`."""
    if content is None:
        raise DatasetError(f"{place} is no LeRobot dataset any more: its {layout.INFO} is gone.")
    try:
        return checked_info(parse_object(content), place)
    except InfoError as error:
        raise DatasetError(f"{place} is no LeRobot dataset: in its {layout.INFO}, {error}.") from error
