"""A dataset below a URL: an object store, a folder, anything that fsspec knows.

A push removes `meta/info.json` first and writes it after all other files, so that a reader finds either all of a
dataset or none.
"""

import contextlib
import errno
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.remote.listing import WORKERS, Item, RemoteFile, listed
from bhd_lerobot.datasets.remote.local import LocalDataset
from bhd_lerobot.datasets.remote.url import LOCAL, open_place, shown
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import BhdError, TransferError

_FOLDERS = {"file", "local", "sftp", "ssh", "ftp", "smb", "hdfs", "arrow_hdfs", "webhdfs", "webdav", "dbfs"}
"""Where folders must be made first. To make the folder of an object store's object may mean to make a bucket."""

_VERSION = ("size", "mtime", "created", "updated", "last_modified", "LastModified", "etag", "ETag")
"""What file systems list of a file that changes when it is written again."""


class StoreDataset:
    """A dataset below a URL."""

    has_checksums = False

    def __init__(self, url: str, storage_options: dict[str, Any] | None = None) -> None:
        self.name = shown(url)
        self._fs, self._root = open_place(url, storage_options)
        kinds = self._fs.protocol if isinstance(self._fs.protocol, tuple) else (self._fs.protocol,)
        self._has_folders = not _FOLDERS.isdisjoint(kinds)
        self.folder: Path | None = Path(self._root) if not LOCAL.isdisjoint(kinds) else None
        # Others, such as FTP, have one connection for all threads.
        self._workers = WORKERS if self._fs.async_impl or not {*LOCAL, "memory"}.isdisjoint(kinds) else 1
        self._versions: dict[str, dict[str, Any]] = {}

    def files(self) -> dict[str, RemoteFile]:
        """Return all files by path, without checksums."""
        self._versions = self._list()
        return {path: RemoteFile(int(about["size"] or 0), None) for path, about in self._versions.items()}

    def read(self, path: str) -> bytes | None:
        """Return a file; None if there is none of this name."""
        with store_errors(self.name, f"read {path} of"):
            try:
                return bytes(self._fs.cat_file(self._at(path)))
            except FileNotFoundError:
                return None

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Copy files into an empty folder, and check that none was written meanwhile."""

        def fetch_one(path: str) -> None:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            self._fs.get_file(self._at(path), str(folder / path))

        with store_errors(self.name, "download"):
            self._each(fetch_one, paths)
        now = self._list()
        if changed := [path for path in paths if now.get(path) != self._versions[path]]:
            raise TransferError(f"{self.name} was changed while it was read: {listed(changed)}. Pull it again.")

    def send(self, source: LocalDataset, items: Sequence[Item], deleted: Sequence[str]) -> None:
        """Remove `meta/info.json`, write files and remove others, and write `meta/info.json` when all are there."""
        sent = {item.path: item for item in items}
        info = sent.pop(layout.INFO)
        with store_errors(self.name, "upload the dataset to"):
            self._remove(layout.INFO)
            # In a folder, what is written anew is removed first: a snapshot made of hard links stays as it was.
            self._each(self._remove, [*deleted, *(sent if self.folder is not None else ())])
            self._each(lambda path: self._write(sent[path]), sent)
            source.check_unchanged()
            there = self.files()
            if lost := [path for path, one in sent.items() if path not in there or there[path].size != one.size]:
                raise TransferError(f"{self.name} lacks files that were sent: {listed(lost)}.")
            self._write(info)

    def _list(self) -> dict[str, dict[str, Any]]:
        with store_errors(self.name, "read"):
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(self._root, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                return {}  # a folder or a prefix that is not written yet; a missing bucket fails when it is written
            root = self._fs._strip_protocol(self._root).rstrip("/")
        paths = {name[len(root) :].removeprefix("/"): about for name, about in found.items()}
        # Consoles of object stores make folders by empty objects whose names end in a slash, or have no name at all
        # below the root.
        return {
            path: {name: about[name] for name in _VERSION if name in about}
            for path, about in paths.items()
            if about.get("type") != "directory" and path[-1:] not in ("", "/")
        }

    def _each(self, work: Callable[[str], None], paths: Collection[str]) -> None:
        """Do something for every path, in threads; none is begun after one has failed."""
        with ThreadPoolExecutor(self._workers) as pool:
            for _ in pool.map(work, paths):
                pass

    def _write(self, item: Item) -> None:
        target = self._at(item.path)
        if self._has_folders:
            self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        if isinstance(item.content, Path):
            self._fs.put_file(str(item.content), target)
        else:
            self._fs.pipe_file(target, item.content)

    def _remove(self, path: str) -> None:
        # One by one: `rm` takes brackets and stars in a name for a pattern, and removes what it fits.
        with contextlib.suppress(FileNotFoundError):
            self._fs.rm_file(self._at(path))

    def _at(self, path: str) -> str:
        return f"{self._root.rstrip('/')}/{path}"


@contextmanager
def store_errors(url: str, action: str) -> Iterator[None]:
    """Turn what goes wrong between this machine and a store into a `TransferError`."""
    try:
        yield
    except BhdError:
        raise
    except Exception as error:  # of fsspec, of the store's own client: each has its own tree
        raise TransferError(f"Could not {action} {url}: {_explain(error)}") from error


def _explain(error: BaseException) -> str:
    kind, text = type(error).__name__, " ".join(str(error).split())[:300].rstrip(".")
    said = text or kind
    meanings = [
        (
            "Credentials" in kind or "Unable to locate credentials" in text,
            f"no credentials were found ({said}). Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile.",
        ),
        (
            "EndpointConnection" in kind or isinstance(error, ConnectionError) or "Could not connect" in text,
            f"the store cannot be reached ({said}). Check the connection, and AWS_ENDPOINT_URL of your own store.",
        ),
        (
            isinstance(error, FileNotFoundError),
            f"it does not exist ({said}). Check the name; a bucket must be made first.",
        ),
        (
            isinstance(error, PermissionError),
            f"no permission ({said}). The key may be wrong or have expired, or may not be used for this.",
        ),
        (
            isinstance(error, TimeoutError) or "Timeout" in kind,
            f"the store did not answer in time ({said}). Check the connection.",
        ),
        (
            isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
            f"the disk is full ({said}). Free some space on it.",
        ),
    ]
    return next((meaning for holds, meaning in meanings if holds), f"{text or 'no reason given'} ({kind}).")
