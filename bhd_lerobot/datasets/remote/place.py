"""Places that a dataset is copied to or from: the Hub, or a URL of a file system that fsspec knows."""

import os
import re
from typing import Any

from bhd_lerobot.errors import ConfigError, TransferError

LOCAL = {"file", "local"}
"""Protocols of this machine's own folders."""

_BUCKETS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oci", "oss", "r2"}
_NO_PLACES = {"http", "https", "data", "hf", "lerobot", "github", "git", "zip", "tar", "libarchive", "reference", "dir"}
_NO_PLACES |= {"simplecache", "filecache", "blockcache", "cached", "generic", "jupyter", "jlab", "dask", "dropbox"}
"""What fsspec knows, too, and what no dataset can be written to, listed and read from by a URL alone."""

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


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


def shown(url: str) -> str:
    """Return a URL as it may be printed and kept: without a password, which may hold any character."""
    return re.sub(r"(://)[^@]*:.*@", r"\1", url.partition("://")[0] + "://" + url.partition("://")[2].rstrip("/"))


def open_url(url: str, storage_options: dict[str, Any] | None = None) -> tuple[Any, str]:
    """Return fsspec's file system for a URL, and the path of the folder in it."""
    import fsspec  # type: ignore[import-untyped]
    from fsspec.core import url_to_fs  # type: ignore[import-untyped]

    protocol, _, path = url.partition("://")
    known = sorted({str(one) for one in fsspec.available_protocols()} - _NO_PLACES)
    wrong = [
        (not url.isprintable(), "it has characters that are not valid in a URL"),
        ("::" in url, "it is a chain of file systems; name the one that holds the dataset"),
        (not protocol, "it names no protocol"),
        (protocol in _NO_PLACES, f"{protocol}:// cannot be written, listed and read by a URL alone"),
        (not path.strip("/"), "it names no folder"),
        (protocol in _BUCKETS and path.startswith("/"), "it names no bucket"),
        (protocol in LOCAL and path.startswith("localhost/"), f"write {protocol}://{path.removeprefix('localhost')}"),
        (
            protocol in LOCAL and not path.startswith("/"),  # fsspec would take it from the working folder
            f"it is not a whole path; this folder is {protocol}://{os.path.abspath(os.path.expanduser(path))}",
        ),
        (protocol not in known, f"Protocol not known: {protocol}. Known protocols: {', '.join(known)}"),
    ]
    reason = next((reason for is_wrong, reason in wrong if is_wrong), "")
    try:
        if not reason:
            fs, found = url_to_fs(url.rstrip("/"), **(storage_options or {}))
            return fs, str(found)
    except ImportError as error:
        raise TransferError(f"The package for {protocol}:// is not installed: {error}.") from error
    except OSError as error:  # those that connect at once: FTP, SFTP
        raise TransferError(
            f"The server of {shown(url)} cannot be reached ({error}). Check the name and the connection."
        ) from error
    except Exception as error:  # each file system has its own idea of what it needs
        reason = f"{' '.join(str(error).split()).rstrip('.')}; check --storage_options"
    text = shown(url) if url.isprintable() else repr(shown(url))
    raise ConfigError(
        f"{text} cannot hold a dataset: {reason}. Give the URL of a folder, such as s3://bucket/folder or file:///folder."
    )
