"""What fsspec's file systems, the network and the disk say, in sentences with a remedy."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from bhd_lerobot.errors import BhdError, TransferError


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
