"""A Hub on this machine, over plain HTTP: knows users by their tokens, counts what it is asked, fails on demand."""

import re
import threading
from http.server import ThreadingHTTPServer
from typing import Self

from .protocol import HubHandler
from .repository import Repository
from .transport import Fault


class HubServer:
    """The server; a context manager that runs it in threads.

    Attributes:
        tokens: user by token; a token that starts with `read` may not write.
        expired: tokens that the server does not accept any more.
        repositories: by `datasets/user/name` or `models/user/name`.
        faults: what goes wrong.
        requests: `METHOD path` of every request, in order.
        received: bytes of LFS objects that came in.
        sent: bytes of files that went out.
    """

    def __init__(self) -> None:
        self.tokens = {"hf_me": "me", "read_me": "me", "hf_other": "other"}
        self.expired: set[str] = set()
        self.repositories: dict[str, Repository] = {}
        self.faults: list[Fault] = []
        self.requests: list[str] = []
        self.received = self.sent = 0
        self.lock = threading.RLock()
        handler = type("Handler", (HubHandler,), {"hub": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        """What `HF_ENDPOINT` is to be."""
        return f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> Self:
        """Start."""
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()

    def dataset(self, name: str) -> Repository:
        """Return a dataset repository."""
        return self.repositories[f"datasets/{name}"]

    def reset(self) -> None:
        """Forget faults and counts, not the repositories."""
        self.faults, self.requests, self.expired = [], [], set()
        self.received = self.sent = 0

    def asked(self, pattern: str) -> list[str]:
        """Return the requests that match."""
        return [request for request in self.requests if re.search(pattern, request)]
