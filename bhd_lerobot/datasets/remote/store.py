"""A dataset below a URL: an object store, a folder, anything that fsspec knows.

Beside the dataset lies a manifest of its files with their checksums, because object stores keep none that all of them
mean the same by. `meta/info.json` is removed first and written after all other files, so that a reader finds either all
of a dataset or none; the manifest is written last.
"""

import contextlib
import errno
import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.remote.listing import (
    CARD,
    LISTED,
    MANIFEST,
    PREVIEW,
    WORKERS,
    Item,
    RemoteFile,
    digest,
    largest_first,
    refuse_damaged,
    run_all,
)
from bhd_lerobot.datasets.remote.local import LocalDataset
from bhd_lerobot.datasets.remote.url import LOCAL, open_place, shown
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import BhdError, TransferError

_FOLDERS = {"file", "local", "sftp", "ssh", "ftp", "smb", "hdfs", "arrow_hdfs", "webhdfs", "webdav", "dbfs"}
"""Where folders must be made first. To make the folder of an object store's object may mean to make a bucket."""

_NOTED_BYTES = 64e6
"""Bytes that are sent before the manifest is written: about as much is sent again after a kill."""

_PART = ".bhd-part"
"""Ends the temporary names of files that are being written to a folder, and no other."""


class StoreDataset:
    """A dataset below a URL.

    Attributes:
        name: the URL.
        folder: where it lies, if that is on this machine.
    """

    def __init__(self, url: str, storage_options: dict[str, Any] | None = None) -> None:
        """Name it; nothing is requested yet.

        Args:
            url: for example ``s3://bucket/folder``.
            storage_options: what fsspec's file system takes: keys, endpoint; else its environment variables count.

        Raises:
            ConfigError: an unknown protocol, or a URL that is no place for a dataset.
            TransferError: what serves this protocol is not installed, or cannot be reached.
        """
        self.name = shown(url)
        self._fs, self._root = open_place(url, storage_options)
        kinds = self._fs.protocol if isinstance(self._fs.protocol, tuple) else (self._fs.protocol,)
        self._has_folders = not _FOLDERS.isdisjoint(kinds)
        self.folder: Path | None = Path(self._root) if not LOCAL.isdisjoint(kinds) else None
        # Others, such as FTP, have one connection for all threads.
        self._workers = WORKERS if self._fs.async_impl or not {*LOCAL, "memory"}.isdisjoint(kinds) else 1
        self._there: dict[str, RemoteFile] = {}
        self._known: dict[str, RemoteFile] = {}  # what the manifest has, or will have
        self._noted: dict[str, RemoteFile] = {}  # what the manifest has
        self._former_info = ""  # of a push that has not ended: what it took away

    def files(self) -> dict[str, RemoteFile]:
        """Return all files by path; those that another program put there have no checksum."""
        with store_errors(self.name, "read"):
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(self._root, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                found = {}  # a folder or a prefix that is not written yet; a missing bucket fails when it is written
            root = self._fs._strip_protocol(self._root).rstrip("/")
            sizes = {
                name[len(root) :].removeprefix("/"): int(about["size"] or 0)
                for name, about in found.items()
                if about.get("type") != "directory"
            }
            # Consoles of object stores make folders by empty objects whose names end in a slash, or have no name at all
            # below the root; and a kill leaves files under their temporary names.
            sizes = {
                path: size for path, size in sizes.items() if path[-1:] not in ("", "/") and not path.endswith(_PART)
            }
            self._read_manifest(exists=sizes.pop(MANIFEST, None) is not None)
        # Where the size is not the one that was written, the checksum will not be either: that is reported.
        self._there = {
            path: replace(self._known.get(path, RemoteFile(size, None)), size=size) for path, size in sizes.items()
        }
        return dict(self._there)

    def read(self, path: str) -> bytes | None:
        """Return a file; None if there is none of this name."""
        with store_errors(self.name, f"read {path} of"):
            try:
                return bytes(self._fs.cat_file(self._at(path)))
            except FileNotFoundError:
                return (self._former_info.encode() or None) if path == layout.INFO else None

    def verified(self, paths: Sequence[str]) -> dict[str, RemoteFile]:
        """Return listed files with the checksum of what lies there now, which is read for it."""
        found: dict[str, RemoteFile] = {}

        def read(path: str) -> None:
            size = self._there[path].size
            with self._fs.open(self._at(path), "rb") as file:
                found[path] = RemoteFile(size, digest(file, size, LISTED), LISTED)

        with store_errors(self.name, "read"):
            run_all(read, largest_first(paths, self._there), self._workers)
        self._there |= found
        self._known |= found
        return found

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Copy files into a folder, and compare them with their checksums."""

        def fetch_one(path: str) -> None:
            part = folder / f"{path}.part"
            part.parent.mkdir(parents=True, exist_ok=True)
            self._fs.get_file(self._at(path), str(part))
            refuse_damaged(part, self._there[path], self.name, path)
            Disk().move(part, folder / path)

        # A file system that is asynchronous does all downloads in one thread: ours wait for it, or make checksums.
        workers = 2 * WORKERS if self._fs.async_impl else self._workers
        with store_errors(self.name, "download"):
            run_all(fetch_one, largest_first(paths, self._there), workers)

    def send(self, source: LocalDataset, items: Sequence[Item], deleted: Sequence[str]) -> None:
        """Remove `meta/info.json`, write files and remove others, then write it again, and the manifest last.

        The manifest is also written before and in between, so that a push that is repeated knows what has arrived.
        """
        sent = {item.path: item for item in items}
        changes_data = any(path not in (CARD, PREVIEW) for path in (*sent, *deleted))
        if not sent and not deleted and self._known == self._noted:
            return
        with store_errors(self.name, "upload the dataset to"):
            if changes_data:
                sent[layout.INFO] = source.info
                self._former_info = (self.read(layout.INFO) or b"").decode(errors="replace")
            for path in (*sent, *deleted):
                self._known.pop(path, None)  # before it is overwritten: it must never be taken for what it was
            self._write_manifest()
            info = sent.pop(layout.INFO, None)
            if info is not None:
                self._remove(layout.INFO)  # a reader who comes now finds no dataset; better than one of two versions
            run_all(self._remove, deleted, self._workers)
            try:
                self._put(sent)
                source.check_unchanged()
            except BaseException:  # Ctrl-C as well
                with contextlib.suppress(Exception):  # the first error is more specific
                    self._write_manifest()
                raise
            if info is not None:
                self._put({layout.INFO: info})
            self._former_info = ""
            self._write_manifest()

    def _put(self, items: dict[str, Item]) -> None:
        """Write files, and note now and then those that have arrived."""
        lock, unnoted = threading.Lock(), 0

        def put(path: str) -> None:
            nonlocal unnoted
            item = items[path]
            about = RemoteFile(item.size, digest(item.content, item.size, LISTED), LISTED)
            self._write(path, item.content)
            with lock:
                self._known[path] = about
                unnoted += item.size
                if unnoted > _NOTED_BYTES:
                    unnoted = 0
                    self._write_manifest()

        run_all(put, largest_first(items, items), self._workers)

    def _write(self, path: str, content: Path | bytes) -> None:
        target = part = self._at(path)
        if self._has_folders:
            self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        if self.folder is not None:  # a snapshot of hard links keeps what the file was
            folder, _, name = target.rpartition("/")
            part = f"{folder}/.{name}{_PART}"
        if isinstance(content, Path):
            self._fs.put_file(str(content), part)
        else:
            self._fs.pipe_file(part, content)
        if part != target:
            Disk().move(Path(part), Path(target))

    def _remove(self, path: str) -> None:
        # One by one: `rm` takes brackets and stars in a name for a pattern, and removes what it fits.
        with contextlib.suppress(FileNotFoundError):
            self._fs.rm_file(self._at(path))

    def _read_manifest(self, *, exists: bool) -> None:
        """Read the manifest; nothing if it cannot be read: then all is sent again."""
        try:
            found = json.loads(self._fs.cat_file(self._at(MANIFEST)) if exists else "{}")
            self._former_info = str(found.get("info", ""))
            self._known = {
                path: RemoteFile(int(one["size"]), str(one[LISTED]), LISTED)
                for path, one in found.get("files", {}).items()
            }
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            self._known, self._former_info = {}, ""
        self._noted = dict(self._known)

    def _write_manifest(self) -> None:
        files = {path: {"size": one.size, LISTED: one.digest} for path, one in sorted(self._known.items())}
        content = json.dumps({"format": 1, "info": self._former_info, "files": files}, indent=1).encode()
        self._write(MANIFEST, content)
        self._noted = dict(self._known)

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
    for holds, meaning in (
        (
            "Credentials" in kind or "Unable to locate credentials" in text,
            "no credentials were found ({}). For S3 set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile.",
        ),
        (
            "EndpointConnection" in kind or isinstance(error, ConnectionError) or "Could not connect" in text,
            "the store cannot be reached ({}). Check the connection, and AWS_ENDPOINT_URL for a store of your own.",
        ),
        (
            isinstance(error, FileNotFoundError),
            "it does not exist ({}). Check the name; a bucket must be made first.",
        ),
        (
            isinstance(error, PermissionError),
            "no permission ({}). The key may be wrong or have expired, or may not be used for this.",
        ),
        (
            isinstance(error, TimeoutError) or "Timeout" in kind,
            "the store did not answer in time ({}). Check the connection.",
        ),
        (
            isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
            "the disk is full ({}). Free some space on it.",
        ),
    ):
        if holds:
            return meaning.format(text or kind)
    return f"{text or 'no reason given'} ({kind})."
