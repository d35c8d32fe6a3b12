"""A dataset below a URL: an object store, a folder, anything that fsspec knows.

A push removes `meta/info.json` first and writes it after all other files, so that a reader finds either all of a
dataset or none.
"""

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.remote.errors import transfer_errors
from bhd_lerobot.datasets.remote.hub import HubDataset
from bhd_lerobot.datasets.remote.listing import RemoteFile
from bhd_lerobot.datasets.remote.place import LOCAL, open_url, shown
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, TransferError, brief

_FOLDERS = {"file", "local", "sftp", "ssh", "ftp", "smb", "hdfs", "arrow_hdfs", "webhdfs", "webdav", "dbfs"}
"""Where folders must be made first. To make the folder of an object store's object may mean to make a bucket."""

_VERSION = ("size", "mtime", "created", "updated", "last_modified", "LastModified", "etag", "ETag")
"""What file systems list of a file that changes when it is written again."""


class StoreDataset:
    """A dataset below a URL."""

    has_checksums = False

    def __init__(self, url: str, storage_options: dict[str, Any] | None = None) -> None:
        self.name = shown(url)
        self._fs, self._root = open_url(url, storage_options)
        kinds = {self._fs.protocol} if isinstance(self._fs.protocol, str) else {*self._fs.protocol}
        self._has_folders = not _FOLDERS.isdisjoint(kinds)
        self.folder: Path | None = Path(self._root) if not LOCAL.isdisjoint(kinds) else None
        self._versions: dict[str, dict[str, Any]] = {}

    def files(self) -> dict[str, RemoteFile]:
        """Return all files by path, without checksums."""
        self._versions = self._list()
        return {path: RemoteFile(int(about["size"] or 0)) for path, about in self._versions.items()}

    def read(self, path: str) -> bytes:
        """Return a file."""
        with transfer_errors(self.name, f"read {path} of"):
            return bytes(self._fs.cat_file(self._at(path)))

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Copy files into an empty folder, and check that none was written meanwhile."""
        for path in paths:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with transfer_errors(self.name, "download"):
            self._fs.get([self._at(path) for path in paths], [str(folder / path) for path in paths])
        now = self._list()
        if changed := [path for path in paths if now.get(path) != self._versions[path]]:
            raise TransferError(f"{self.name} was changed while it was read: {brief(sorted(changed))}. Pull it again.")

    def send(self, files: Mapping[str, Path], deleted: Sequence[str], check: Callable[[], None]) -> None:
        """Remove `meta/info.json`, write files and remove others, and write `meta/info.json` when all are there."""
        others = {path: file for path, file in files.items() if path != layout.INFO}
        with transfer_errors(self.name, "upload the dataset to"):
            # In a folder, what is written anew is removed first: a snapshot made of hard links stays as it was.
            self._remove([layout.INFO, *deleted, *(others if self.folder is not None else ())])
            self._put(others)
            check()
            there = self.files()
            if lost := [path for path, file in others.items() if path not in there or not there[path].matches(file)]:
                raise TransferError(f"{self.name} lacks files that were sent: {brief(sorted(lost))}.")
            self._put({layout.INFO: files[layout.INFO]})

    def _list(self) -> dict[str, dict[str, Any]]:
        with transfer_errors(self.name, "read"):
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(self._root, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                return {}  # a folder or a prefix that is not written yet; a missing bucket fails when it is written
            root = self._fs._strip_protocol(self._root).rstrip("/")
        # Consoles of object stores make folders by empty objects whose names end in a slash, or have no name at all
        # below the root.
        return {
            path: {name: about[name] for name in _VERSION if name in about}
            for path, about in ((name[len(root) :].removeprefix("/"), about) for name, about in found.items())
            if about.get("type") != "directory" and path[-1:] not in ("", "/")
        }

    def _put(self, files: Mapping[str, Path]) -> None:
        targets = [self._at(path) for path in files]
        if self._has_folders:
            for folder in {target.rpartition("/")[0] for target in targets}:
                self._fs.makedirs(folder, exist_ok=True)
        self._fs.put([str(file) for file in files.values()], targets)

    def _remove(self, paths: Iterable[str]) -> None:
        # One by one: `rm` takes brackets and stars in a name for a pattern, and removes what it fits.
        for path in paths:
            with contextlib.suppress(FileNotFoundError):
                self._fs.rm_file(self._at(path))

    def _at(self, path: str) -> str:
        return f"{self._root.rstrip('/')}/{path}"


type Remote = HubDataset | StoreDataset
"""A place that a dataset is copied to or from. Every method raises `TransferError` if the place refuses it.

Where `has_checksums` is on, files are listed with theirs, and an interrupted download can be resumed.
"""


def refuse_overlap(root: Path, remote: Remote) -> None:
    """Refuse to copy a dataset onto itself, or into itself: its files would be removed to be replaced."""
    if remote.folder is None:
        return
    here, there = root.expanduser().resolve(), remote.folder.expanduser().resolve()
    is_one = here.exists() and there.exists() and os.path.samefile(here, there)
    if is_one or here.is_relative_to(there) or there.is_relative_to(here):
        raise ConfigError(f"{remote.name} and {root} are the same folder, or one lies in the other. Name another one.")
