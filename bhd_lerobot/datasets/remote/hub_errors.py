"""What the Hub's client, the network and the disk say, in sentences with a remedy."""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from bhd_lerobot.errors import BhdError, TransferError

_LOGIN = "Log in with `hf auth login`, or set the environment variable HF_TOKEN"
_CONNECTION = "Check the connection"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_STATUS = {
    403: "this token has no permission for it. Use one that may write, and a name of your own or of an organisation "
    "that you may write to.",
    409: "it was changed by another client at the same time. Check what is there now.",
    412: "it was changed by another client at the same time. Check what is there now.",
    413: "the Hub refuses so much at once.",
    429: "the Hub has had too many requests from here. Wait some minutes.",
}


@contextmanager
def hub_errors(name: str, action: str, *, revision: str | None = None) -> Iterator[None]:
    """Turn what goes wrong between this machine and the Hub into a `TransferError`.

    Args:
        name: the repository.
        action: what is being done, for example ``"upload the dataset to"``.
        revision: the branch, tag or commit that is requested; None if none is.
    """
    try:
        yield
    except BhdError:
        raise
    except Exception as error:  # of the Hub's client, of its threads, of httpx, of hf_xet: each has its own tree
        raise TransferError(f"Could not {action} {name}: {explain(error, name, revision)}") from error


def explain(error: BaseException, name: str, revision: str | None = None) -> str:
    """Return what an error means and what to do about it."""
    chain = _chain(error)
    meanings = _meanings(name, revision)
    for cause in chain:
        for kind, meaning in meanings:
            if isinstance(cause, kind) and (message := meaning(cause)):
                return message
    text = " ".join(str(error).split())
    is_xet = any("xet" in str(cause).lower() for cause in chain)
    hint = " If this Hub does not know the Xet protocol, set HF_HUB_DISABLE_XET=1." if is_xet else ""
    return f"{text[:400].rstrip('.') or 'no reason given'} ({type(error).__name__}).{hint}"


def require_token(name: str) -> None:
    """Check that there is something to log in with.

    Raises:
        TransferError: there is no token.
    """
    from huggingface_hub import get_token

    if not get_token():
        raise TransferError(f"Could not write to {name}: no token of the Hub was found. {_LOGIN}.")


def _meanings(name: str, revision: str | None) -> list[tuple[type, Callable[[Any], str]]]:
    """Return what each kind of error means, the more special ones first; an empty text means nothing special."""
    import httpx
    from huggingface_hub import errors

    return [
        (
            errors.OfflineModeIsEnabled,
            lambda _: "HF_HUB_OFFLINE is set, so nothing may be sent or fetched. Unset it.",
        ),
        (errors.LocalTokenNotFoundError, lambda _: f"no token of the Hub was found. {_LOGIN}."),
        (
            errors.GatedRepoError,
            lambda _: "it is gated: its owner grants access on request. Request it on its page on the Hub.",
        ),
        (
            errors.RevisionNotFoundError,
            lambda _: f"it has no revision {revision!r}. Give a branch, a tag or a commit that it has.",
        ),
        (
            errors.RemoteEntryNotFoundError,
            lambda one: f"a file is missing there ({_short(one)}). It may have been changed meanwhile.",
        ),
        (errors.HfHubHTTPError, lambda one: _status(one, name)),
        (errors.HFValidationError, lambda one: f"{_short(one)}. A name on the Hub looks like user/name."),
        (
            httpx.ConnectError,
            lambda one: f"the Hub at {_host(one)} cannot be reached ({_short(one)}). {_CONNECTION}, and HF_ENDPOINT.",
        ),
        (
            httpx.TimeoutException,
            lambda one: f"the Hub did not answer in time ({type(one).__name__}). {_CONNECTION}.",
        ),
        (
            httpx.TransportError,
            lambda one: f"the connection was lost ({_short(one) or type(one).__name__}). {_CONNECTION}.",
        ),
        (OSError, _system),
    ]


def _system(error: OSError) -> str:
    where = error.filename2 or error.filename
    place = f" ({where})" if where else ""
    if error.errno in _FULL:
        return f"{os.strerror(error.errno)}{place}. Free some space on this disk."
    if isinstance(error, PermissionError) and where:
        return f"{error.strerror}{place}. Check the permissions of this path."
    if "Consistency check failed" in str(error):
        return f"the connection was lost in the middle of a file. {_CONNECTION}."
    return ""


def _status(error: BaseException, name: str) -> str:
    from huggingface_hub import get_token

    status = getattr(getattr(error, "response", None), "status_code", 0)
    answer = " ".join(str(getattr(error, "server_message", None) or "").split())
    quoted = f' The Hub says: "{answer[:200]}".' if answer else ""
    if status == 401 and get_token():
        meaning = f"the Hub does not accept the token: it has expired or was revoked. {_LOGIN} to a new one."
    elif status in (401, 404):
        private = "this token may not see it" if get_token() else f"it is private. {_LOGIN} if it is"
        meaning = f"there is no such repository, or {private}. Check the name {name!r}."
    elif status >= 500:
        meaning = f"the Hub has an error of its own (status {status}). Wait a while."
    else:
        meaning = _STATUS.get(status, f"the Hub answers with status {status}.")
    return meaning + quoted


def _chain(error: BaseException) -> list[BaseException]:
    """Return an error and what caused it."""
    found: list[BaseException] = []
    pending: BaseException | None = error
    while pending is not None and pending not in found:
        found.append(pending)
        pending = pending.__cause__ or pending.__context__
    return found


def _host(error: BaseException) -> str:
    from huggingface_hub import constants

    try:
        url = error.request.url  # type: ignore[attr-defined]
        return f"{url.scheme}://{url.netloc.decode()}"
    except (AttributeError, RuntimeError):
        return str(constants.ENDPOINT)


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200].rstrip(".")
