"""What clients of the Hub and of stores, the network and the disk report, in sentences with a remedy."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager

from bhd_lerobot.errors import BhdError, TransferError

_LOGIN = "Log in with `hf auth login`, or set the environment variable HF_TOKEN"
_CHANGED = "it was changed by another client at the same time. Check what is there now."

_STATUS = {
    403: "this token has no permission for it. Use one that may write, and a name of your own or of an organisation "
    "that you may write to.",
    409: _CHANGED,
    412: _CHANGED,
    413: "the Hub refuses so much at once.",
    429: "the Hub has had too many requests from here. Wait some minutes.",
}


@contextmanager
def transfer_errors(name: str, action: str, *, revision: str | None = None) -> Iterator[None]:
    """Turn what goes wrong between this machine and another place into a `TransferError`."""
    try:
        yield
    except BhdError:
        raise
    except Exception as error:  # of the client, its threads, httpx, hf_xet, fsspec, a store: each has its own tree
        raise TransferError(f"Could not {action} {name}: {explain(error, name, revision)}") from error


def explain(error: BaseException, name: str, revision: str | None = None) -> str:
    """Return what an error means and what to do about it."""
    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:
        chain.append(cause)
        cause = cause.__cause__ or cause.__context__
    if meaning := next(filter(None, (_meaning(one, name, revision) for one in chain)), ""):
        return meaning
    is_xet = any("xet" in str(one).lower() for one in chain)
    hint = " If this Hub does not know the Xet protocol, set HF_HUB_DISABLE_XET=1." if is_xet else ""
    return f"{_short(error, 400) or 'no reason given'} ({type(error).__name__}).{hint}"


def require_token(name: str) -> None:
    """Check that there is something to log in with."""
    from huggingface_hub import get_token

    if not get_token():
        raise TransferError(f"Could not write to {name}: no token of the Hub was found. {_LOGIN}.")


def _meaning(error: BaseException, name: str, revision: str | None) -> str:
    """Return what one error means; nothing if it says nothing special."""
    import httpx
    from huggingface_hub import constants, errors

    short, kind = _short(error), type(error).__name__
    is_store = "://" in name
    where, own = ("the store", ", and AWS_ENDPOINT_URL of your own store") if is_store else ("the Hub", "")
    meanings: list[tuple[type | bool, str]] = [  # the more special ones first
        (errors.OfflineModeIsEnabled, "HF_HUB_OFFLINE is set, so nothing may be sent or fetched. Unset it."),
        (errors.LocalTokenNotFoundError, f"no token of the Hub was found. {_LOGIN}."),
        (errors.GatedRepoError, "it is gated: its owner grants access on request. Request it on its page on the Hub."),
        (errors.RevisionNotFoundError, f"it has no revision {revision!r}. Give a branch, a tag or a commit of it."),
        (errors.RemoteEntryNotFoundError, f"a file is missing there ({short}). It may have been changed meanwhile."),
        (errors.HfHubHTTPError, _status(error, name)),
        (errors.HFValidationError, f"{short}. A name on the Hub looks like user/name."),
        (
            httpx.ConnectError,
            f"the Hub at {constants.ENDPOINT} cannot be reached ({short}). Check the connection, and HF_ENDPOINT.",
        ),
        (httpx.TimeoutException, f"the Hub did not answer in time ({kind}). Check the connection."),
        (httpx.TransportError, f"the connection was lost ({short or kind}). Check the connection."),
        (errors.LocalEntryNotFoundError, ""),  # of its cause: the Hub cannot be reached, or nothing may be fetched
        (
            "Credentials" in kind or "Unable to locate credentials" in short,
            f"no credentials were found ({short}). Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile.",
        ),
        (
            "EndpointConnection" in kind or isinstance(error, ConnectionError) or "Could not connect" in short,
            f"{where} cannot be reached ({short}). Check the connection{own}.",
        ),
        (
            isinstance(error, TimeoutError) or "Timeout" in kind,
            f"{where} did not answer in time ({short or kind}). Check the connection.",
        ),
        (
            is_store and isinstance(error, FileNotFoundError),
            f"it does not exist ({short}). Check the name; a bucket must be made first.",
        ),
        (OSError, _system(error, is_store=is_store) if isinstance(error, OSError) else ""),
    ]
    return next((text for one, text in meanings if (one if isinstance(one, bool) else isinstance(error, one))), "")


def _system(error: OSError, *, is_store: bool) -> str:
    where = error.filename2 or error.filename
    place = f" ({where})" if where else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"{os.strerror(error.errno)}{place}. Free some space on this disk."
    if isinstance(error, PermissionError):
        return f"no permission ({_short(error)}). Check {'the key, or ' * is_store}the permissions of this path."
    if "Consistency check failed" in str(error):
        return "the connection was lost in the middle of a file. Check the connection."
    return ""


def _status(error: BaseException, name: str) -> str:
    from huggingface_hub import get_token

    status = getattr(getattr(error, "response", None), "status_code", 0)
    answer = " ".join(str(getattr(error, "server_message", None) or "").split())
    quoted = f' The answer of the Hub: "{answer[:200]}".' if answer else ""
    if status == 401 and get_token():
        meaning = f"the Hub does not accept the token: it has expired or was revoked. {_LOGIN} to a new one."
    elif status in (401, 404):
        private = "this token may not see it" if get_token() else f"it is private. {_LOGIN} if it is"
        meaning = f"there is no such repository, or {private}. Check the name {name!r}."
    elif status >= 500:
        meaning = f"the Hub reports an internal error (status {status}). Wait a while."
    else:
        meaning = _STATUS.get(status, f"the Hub answers with status {status}.")
    return meaning + quoted


def _short(error: BaseException, at_most: int = 200) -> str:
    return " ".join(str(error).split())[:at_most].rstrip(".")
