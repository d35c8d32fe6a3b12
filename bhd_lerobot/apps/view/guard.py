"""Access control: the server answers the page that it served itself, and no other.

The server listens on loopback, but a browser on the same machine also shows pages of strangers. A page whose host name
was made to resolve to 127.0.0.1 would be of the same origin as ours: its requests carry its host name, and are refused.
A page that sends its requests to us without reading the answer could change the dataset: for that a token is needed
that only our own page holds.
"""

import hmac
import secrets
from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Middleware

TOKEN_HEADER = "X-Bhd-Token"
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_READING = ("GET", "HEAD")
_HEADERS = {
    # Nothing from elsewhere is loaded, and no other page may show or embed what we serve.
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(24)


def guard(token: str) -> Middleware:
    """Return the middleware that refuses strangers, and changes without the token in `TOKEN_HEADER`."""

    @web.middleware
    async def refuse_strangers(
        request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        if not is_loopback(request.headers.get("Host", "")):
            raise web.HTTPForbidden(text="This server answers to localhost and 127.0.0.1 only.\n")
        if request.method not in _READING:
            origin = request.headers.get("Origin")
            if origin is not None and urlsplit(origin).netloc != request.headers["Host"]:
                raise web.HTTPForbidden(text=f"A page of {origin} may not change this dataset.\n")
            if not hmac.compare_digest(request.headers.get(TOKEN_HEADER, "").encode(), token.encode()):
                raise web.HTTPForbidden(text="The page is of a server that has ended; load it again.\n")
        return await handler(request)

    return refuse_strangers


async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Add the headers of every answer; for `Application.on_response_prepare`."""
    response.headers.update(_HEADERS)
    # A browser must not show scripts of an older version, or a dataset that was here before. Asking costs nothing.
    response.headers.setdefault("Cache-Control", "no-cache")


def is_loopback(host: str) -> bool:
    """Return whether a Host header names this machine, with any port: it may be forwarded from another one."""
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        return False
    return "@" not in host and "/" not in host and name in _LOOPBACK
