"""HTTP under the Hub of the tests: requests, answers, and what goes wrong with them on demand."""

import json
import re
import socket
import threading
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import unquote, urlsplit

if TYPE_CHECKING:
    from .server import HubServer


@dataclass
class Fault:
    """What goes wrong with requests that match.

    Attributes:
        request: pattern for `METHOD path`.
        times: how often; -1 for ever.
        status: answered instead; 0 to answer nothing.
        after_bytes: so many bytes of the request or of the answer pass before the connection is cut.
        wait: an event that the answer waits for.
    """

    request: str
    times: int = 1
    status: int = 0
    after_bytes: int = 0
    wait: threading.Event | None = None
    after: int = 0
    """Requests that match and pass before the first that fails."""


class RefusalError(Exception):
    """An answer with an error status."""

    def __init__(self, status: int, message: str = "", code: str = "") -> None:
        self.status, self.message, self.code = status, message, code


class CutError(Exception):
    """The connection ends here."""


class Handler(BaseHTTPRequestHandler):
    """Reads a request, lets the fault that it meets happen, and has it answered by what `routes` names."""

    hub: "HubServer"
    routes: ClassVar[list[tuple[str, str, str]]] = []
    """Methods, pattern of the path, and the name of what answers, in the order in which they are tried."""
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    rbufsize = wbufsize = 1 << 16

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        self._serve()

    do_HEAD = do_GET  # noqa: N815  names of the base class
    do_POST = do_GET  # noqa: N815
    do_PUT = do_GET  # noqa: N815
    do_DELETE = do_GET  # noqa: N815

    def _serve(self) -> None:
        hub = self.hub
        path = unquote(urlsplit(self.path).path)
        line = f"{self.command} {path}"
        with hub.lock:
            hub.requests.append(line)
            self.fault = next((f for f in hub.faults if f.times and re.search(f.request, line)), None)
            if self.fault is not None and self.fault.after > 0:
                self.fault.after -= 1
                self.fault = None
            elif self.fault is not None:
                self.fault.times -= 1
        try:
            body = self._body()
            if self.fault is not None:
                if self.fault.wait is not None:
                    self.fault.wait.wait(60)
                if self.fault.status:
                    raise RefusalError(self.fault.status, "on demand")
                if self.command != "GET" and self.fault.wait is None:
                    raise CutError
            for method, pattern, name in self.routes:
                match = re.fullmatch(pattern, path)
                if match and self.command in method.split():
                    getattr(self, f"_{name}")(body, **match.groupdict())
                    return
            raise RefusalError(404, f"no such route: {line}")
        except RefusalError as refusal:
            self.close_connection = True
            headers = {"X-Error-Message": refusal.message} if refusal.message else {}
            headers |= {"X-Error-Code": refusal.code} if refusal.code else {}
            self._answer({"error": refusal.message}, refusal.status, headers)
        except (CutError, ConnectionError):
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)

    def _body(self) -> bytes:
        limit = self.fault.after_bytes if self.fault and self.command == "PUT" and not self.fault.status else -1
        if self.headers.get("Transfer-Encoding") == "chunked":
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        size = int(self.headers.get("Content-Length") or 0)
        if limit >= 0 and self.fault is not None and self.fault.wait is None:
            self.rfile.read(min(size, limit))
            raise CutError
        return self.rfile.read(size)

    def _answer(self, content: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        values = {"Content-Type": "application/json", "Content-Length": str(len(data)), **(headers or {})}
        for key, value in values.items():
            self.send_header(key, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command == "HEAD":
            return
        if self.fault is not None and not self.fault.status and self.fault.wait is None:
            self.wfile.write(data[: self.fault.after_bytes])
            self.wfile.flush()
            raise CutError
        self.wfile.write(data)
