"""A dataset below a URL: an object store, a folder, anything that fsspec knows.

Beside the dataset lies a list of its files with their checksums, because object stores keep none that all of them mean
the same by. `meta/info.json` is written last and removed first, so that there is either all of a dataset or none.
"""

import contextlib
import errno
import json
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.remote.listing import (
    LISTED,
    MANIFEST,
    Item,
    RemoteFile,
    digest,
    largest_first,
    refuse_damaged,
    stream_digest,
)
from bhd_lerobot.datasets.remote.pool import WORKERS, run_all
from bhd_lerobot.datasets.remote.url import LOCAL, open_place, shown
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import BhdError, TransferError

_FOLDERS = {"file", "local", "sftp", "ssh", "ftp", "smb", "hdfs", "arrow_hdfs", "webhdfs", "webdav", "dbfs"}
"""Where folders must be made first. To make the folder of an object store's object may mean to make a bucket."""

_NOTED_BYTES = 64e6
"""Bytes that are sent before the list is written: about as much is sent again after a kill."""

_PART = ".bhd-part"
"""Ends the temporary names of files that are being written, and no other."""


@dataclass
class Manifest:
    """What the list says.

    Attributes:
        files: files that are known, by path.
        info: the `meta/info.json` that was shown last, while another one is on its way; empty if none is known.
        push: stands for the push that wrote the list last. Each push writes it before anything else and looks at it
            again before it shows what it sent, so that two at once notice each other.
    """

    files: dict[str, RemoteFile] = field(default_factory=dict)
    info: str = ""
    push: str = ""

    def to_json(self) -> bytes:
        """Return it as it is stored."""
        files = {path: {"size": one.size, LISTED: one.digest} for path, one in sorted(self.files.items())}
        return json.dumps({"format": 1, "push": self.push, "info": self.info, "files": files}, indent=1).encode()


def parse_manifest(content: bytes) -> Manifest:
    """Return what a list says; nothing if it cannot be read, as after a kill: then all is compared by sending it."""
    try:
        found = json.loads(content)
        files = {path: RemoteFile(int(one["size"]), str(one[LISTED]), LISTED) for path, one in found["files"].items()}
        return Manifest(files, str(found.get("info", "")), str(found.get("push", "")))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return Manifest()


class StoreDataset:
    """A dataset below a URL.

    Attributes:
        name: the URL.
        folder: where it lies, if that is on this machine.
    """

    def __init__(self, url: str, storage_options: dict[str, Any] | None = None) -> None:
        """Name it; nothing is asked for yet.

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
        # Those that are asynchronous do all downloads in one thread: ours wait for it, or make checksums meanwhile.
        self._fetchers = 2 * WORKERS if self._fs.async_impl else self._workers
        self._list = Manifest()
        self._push = uuid.uuid4().hex
        self._is_noted = True  # whether the list there says what is known
        self._there: dict[str, RemoteFile] = {}

    def files(self) -> dict[str, RemoteFile]:
        """Return all files by path; those that another program put there have no checksum.

        Raises:
            TransferError: the place does not exist, or no permission.
        """
        with store_errors(self.name, "read"):
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(self._root, detail=True)
            except (FileNotFoundError, NotADirectoryError):
                found = {}  # a folder or a prefix that nobody wrote to yet; a missing bucket fails when it is written
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
            self._list = self._read_manifest() if MANIFEST in sizes else Manifest()
        sizes.pop(MANIFEST, None)
        self._there = {}
        for path, size in sizes.items():
            known = self._list.files.get(path)
            # Where the size is not the one that was written, the checksum will not be either: that is told.
            self._there[path] = RemoteFile(size, None) if known is None else replace(known, size=size)
        return dict(self._there)

    def read(self, path: str) -> bytes | None:
        """Return a file; None if there is none of this name."""
        with store_errors(self.name, f"read {path} of"):
            try:
                return bytes(self._fs.cat_file(self._at(path)))
            except FileNotFoundError:
                return None

    def former_info(self) -> bytes | None:
        """Return the `meta/info.json` that was shown last, by the list."""
        return self._list.info.encode() or None

    def verified(self, paths: Sequence[str]) -> dict[str, RemoteFile]:
        """Return listed files with the checksum of what lies there now, which is read for it.

        Raises:
            TransferError: a file cannot be read.
        """
        found: dict[str, RemoteFile] = {}

        def read(path: str) -> None:
            size = self._there[path].size
            with self._fs.open(self._at(path), "rb") as file:
                found[path] = RemoteFile(size, stream_digest(file, size, LISTED), LISTED)

        with store_errors(self.name, "read"):
            run_all(read, largest_first(paths, self._there), self._workers)
        self._there |= found
        self._is_noted = self._is_noted and all(self._list.files.get(path) == file for path, file in found.items())
        self._list.files |= found
        return found

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Copy files into a folder.

        Raises:
            TransferError: not all of them came, or one came otherwise; those that came well are kept.
        """

        def fetch_one(path: str) -> None:
            part = folder / f"{path}.part"
            part.parent.mkdir(parents=True, exist_ok=True)
            self._fs.get_file(self._at(path), str(part))
            refuse_damaged(part, self._there[path], self.name, path)
            part.replace(folder / path)

        with store_errors(self.name, "download"):
            run_all(fetch_one, largest_first(paths, self._there), self._fetchers)

    def send(self, items: Sequence[Item], deleted: Sequence[str], check: Callable[[], None]) -> None:
        """Write files and remove others; the list of files after each batch, and `meta/info.json` last.

        Raises:
            TransferError: not all was written, or another push came between. What was written is not sent again; there
                is no `meta/info.json` then.
        """
        if not items and not deleted and self._is_noted:
            return
        by_path = {item.path: item for item in items}
        info = by_path.pop(layout.INFO, None)
        touched = {*by_path, *deleted}
        with store_errors(self.name, "upload the dataset to"):
            if self._read_manifest().push != self._list.push:
                raise TransferError(f"Another push wrote to {self.name} since this one looked at it. Nothing was sent.")
            is_shown = layout.INFO in self._there
            if is_shown and (deleted or any(path in self._there and _matters(path) for path in by_path)):
                # A reader who comes now finds no dataset; better than one of two versions.
                there = bytes(self._fs.cat_file(self._at(layout.INFO)))
                info = info or self._unchanged(Item(layout.INFO, there, len(there)))
                self._list.info = there.decode(errors="replace")
                self._fs.rm_file(self._at(layout.INFO))
                del self._there[layout.INFO]
            for path in touched & self._list.files.keys():
                del self._list.files[path]  # before it is overwritten: it must never be taken for what it was
            for folder in {self._at(path).rpartition("/")[0] for path in (MANIFEST, layout.INFO, *by_path)}:
                if self._has_folders:
                    self._fs.makedirs(folder, exist_ok=True)
            self._write_manifest()
            try:
                if deleted:
                    run_all(self._remove, deleted, self._workers)
                if by_path:
                    self._put(list(by_path.values()))
                check()
                self._refuse_overtaken()
            except BaseException:  # Ctrl-C as well
                with contextlib.suppress(Exception):  # the first one tells more
                    self._leave(touched)
                raise
            if info is not None:
                content = info.content if isinstance(info.content, bytes) else info.content.read_bytes()
                self._list.files[layout.INFO], self._list.info = _about(info), content.decode(errors="replace")
                self._write_manifest()
                self._put_one(info)

    def _refuse_overtaken(self) -> None:
        """Check that no other push wrote the list since this one did.

        Raises:
            TransferError: one did.
        """
        if self._read_manifest().push != self._push:
            raise TransferError(
                f"Another push wrote to {self.name} at the same time, so what lies there now may be of both. There is "
                "no meta/info.json, so nobody takes it for a dataset. Push again, one after the other."
            )

    def _leave(self, touched: set[str]) -> None:
        """Note what arrived; or, where another push came, let that one notice, and no file be taken for its own."""
        found = self._read_manifest()
        if found.push != self._push:
            self._remove(layout.INFO)
            unclear = {*touched, layout.INFO}
            files = {path: file for path, file in found.files.items() if path not in unclear}
            self._list, self._push = replace(found, files=files), uuid.uuid4().hex
        self._write_manifest()

    def _remove(self, path: str) -> None:
        # One by one: `rm` takes brackets and stars in a name for a pattern, and removes what it fits.
        with contextlib.suppress(FileNotFoundError):
            self._fs.rm_file(self._at(path))

    def _put(self, items: Sequence[Item]) -> None:
        """Write files, and note now and then those that arrived."""
        lock, unnoted = threading.Lock(), 0

        def put(item: Item) -> None:
            nonlocal unnoted
            about = _about(item)
            self._put_one(item)
            with lock:
                self._list.files[item.path] = about
                unnoted += item.size
                if unnoted > _NOTED_BYTES:
                    unnoted = 0
                    self._refuse_overtaken()
                    self._write_manifest()

        run_all(put, sorted(items, key=lambda item: (-item.size, item.path)), self._workers)
        self._refuse_overtaken()
        self._write_manifest()

    def _put_one(self, item: Item) -> None:
        if self.folder is not None:
            self._replace_file(Path(self._at(item.path)), item.content)
        elif isinstance(item.content, Path):
            self._fs.put_file(str(item.content), self._at(item.path))
        else:
            self._fs.pipe_file(self._at(item.path), item.content)

    def _replace_file(self, target: Path, content: Path | bytes) -> None:
        """Write a file beside its place, and let it take the place: another name that the old one has keeps that."""
        part = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}{_PART}")
        try:
            if isinstance(content, Path):
                self._fs.put_file(str(content), str(part))
            else:
                self._fs.pipe_file(str(part), content)
            part.replace(target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise

    def _unchanged(self, info: Item) -> Item:
        if not info.is_like(self._there[layout.INFO]):
            raise TransferError(
                f"Could not upload the dataset to {self.name}: its {layout.INFO} is not what was written there. "
                "Something else wrote it, or it was damaged: push with --verify, which mends that."
            )
        return info

    def _read_manifest(self) -> Manifest:
        try:
            return parse_manifest(self._fs.cat_file(self._at(MANIFEST)))
        except FileNotFoundError:
            return Manifest()

    def _write_manifest(self) -> None:
        self._list.push = self._push
        content = self._list.to_json()
        self._put_one(Item(MANIFEST, content, len(content)))
        self._is_noted = True

    def _at(self, path: str) -> str:
        return f"{self._root.rstrip('/')}/{path}"


def _matters(path: str) -> bool:
    """Return whether a file decides what the dataset is: not its card."""
    return path.startswith(("data/", "videos/", "meta/"))


def _about(item: Item) -> RemoteFile:
    return RemoteFile(item.size, digest(item.content, LISTED), LISTED)


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
