"""URLs as a place for datasets: which ones can be one, and what serves them."""

import os
import re
import sys
import traceback
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import ConfigError, TransferError

LOCAL = {"file", "local"}
"""Protocols of this machine's own folders."""

_BUCKETS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oci", "oss", "r2"}
"""Where the first name of a URL is that of a bucket, or of a container."""

_NO_PLACES = {"http", "https", "data", "hf", "lerobot", "github", "git", "zip", "tar", "libarchive", "reference", "dir"}
_NO_PLACES |= {"simplecache", "filecache", "blockcache", "cached", "generic", "jupyter", "jlab", "dask", "dropbox"}
"""What fsspec knows, too, and what no dataset can be written to, listed and read from by a URL alone."""


def shown(url: str) -> str:
    """Return a URL as it may be printed and kept: without a password, which may hold any character."""
    protocol, mark, path = url.partition("://")
    return re.sub(r"(://)[^@]*:.*@", r"\1", f"{protocol}{mark}{path.rstrip('/')}")


def open_place(url: str, storage_options: dict[str, Any] | None = None) -> tuple[Any, str]:
    """Return fsspec's file system for a URL, and the path of the folder in it."""
    import fsspec  # type: ignore[import-untyped]
    from fsspec.core import url_to_fs  # type: ignore[import-untyped]

    check_url(url)
    protocol = url.partition("://")[0]
    if protocol not in fsspec.available_protocols():
        known = ", ".join(sorted({str(one) for one in fsspec.available_protocols()} - _NO_PLACES))
        raise ConfigError(f"{shown(url)} cannot be used: Protocol not known: {protocol}. Known protocols: {known}.")
    try:
        fs, path = url_to_fs(url.rstrip("/"), **(storage_options or {}))
    except ImportError as error:
        raise TransferError(f"The package for {protocol}:// is not installed: {error}.") from error
    except OSError as error:  # those that connect at once: FTP, SFTP
        _drop_half_made(error)
        reason = " ".join(str(error).split()).rstrip(".")
        raise TransferError(
            f"The server of {shown(url)} cannot be reached ({reason}). Check the name and the connection."
        ) from error
    except Exception as error:  # each file system has its own idea of what it needs
        reason = " ".join(str(error).split()).rstrip(".")
        raise ConfigError(f"{shown(url)} cannot be used: {reason}. Check the URL, and --storage_options.") from error
    return fs, str(path)


def check_url(url: str) -> None:
    """Check what can be seen without asking anybody."""
    protocol, _, path = url.partition("://")
    name = shown(url)
    if not url.isprintable():
        raise ConfigError(f"{name!r} has characters that are not valid in a URL. Correct it.")
    if "::" in url:
        raise ConfigError(f"{name} is a chain of file systems. Name the one that holds the dataset.")
    if not protocol:
        raise ConfigError(f"{name} names no protocol. Write, for example, s3{name}.")
    if protocol in _NO_PLACES:
        raise ConfigError(
            f"{name} cannot be written to or listed: {protocol}:// cannot hold a dataset. Name a folder, such as "
            "s3://bucket/folder or file:///folder, or a dataset on the Hub as user/name."
        )
    if not path.strip("/"):
        raise ConfigError(f"{name} names no folder. Give one, for example {_example(protocol)}.")
    if protocol in LOCAL and not path.startswith("/"):
        # fsspec would take it from the working folder, wherever that is: not the same place the next time.
        rest = path.removeprefix("localhost/") if path.startswith("localhost/") else ""
        whole = Path("/", rest) if rest else Path(os.path.abspath(os.path.expanduser(path)))
        raise ConfigError(f"{name} is not a whole path. Write {protocol}://{whole}.")
    if protocol in _BUCKETS and path.startswith("/"):
        raise ConfigError(f"{name} names no bucket. Give one, for example {_example(protocol)}.")


def _example(protocol: str) -> str:
    return f"{protocol}:///folder" if protocol in LOCAL else f"{protocol}://bucket/folder"


def _drop_half_made(error: BaseException) -> None:
    """Let go of a file system that failed while it was made: fsspec's FTP complains about itself when it goes."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        traceback.clear_frames(error.__traceback__)
    finally:
        sys.unraisablehook = hook
