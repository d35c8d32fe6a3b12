"""A dataset that is served to a test, and how the test asks for something."""

import asyncio
import http.client
import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web

from bhd_lerobot.apps.view.dataset import ViewedDataset
from bhd_lerobot.apps.view.guard import TOKEN_HEADER
from bhd_lerobot.apps.view.packing import unpack
from bhd_lerobot.apps.view.server import HOST, application


class Served:
    """The server of a dataset, as a browser sees it."""

    def __init__(self, root: Path, port: int) -> None:
        self.root, self.port, self.url = root, port, f"http://{HOST}:{port}/"

    def ask(
        self, path: str, *, method: str = "GET", body: Any = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        """Return status, headers and content of an answer; the path is sent as it is."""
        connection = http.client.HTTPConnection(HOST, self.port)
        content = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, content, dict(headers or {}))
        answer = connection.getresponse()
        found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        connection.close()
        return found

    def json(self, path: str) -> Any:
        status, _, content = self.ask(path)
        assert status == 200, content
        return json.loads(content)

    def token(self) -> str:
        _, _, page = self.ask("/")
        return re.search(r'name="bhd-token" content="([^"]+)"', page.decode()).group(1)

    def mark(self, index: int, what: Any, **headers: str) -> tuple[int, bytes]:
        status, _, content = self.ask(
            f"/api/episodes/{index}/mark", method="POST", body=what, headers={TOKEN_HEADER: self.token(), **headers}
        )
        return status, content


def episode(server: Served, index: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what the page is sent of an episode."""
    status, _, content = server.ask(f"/api/episodes/{index}")
    assert status == 200, content
    return unpack(content)


@contextmanager
def served(root: Path) -> Iterator[Served]:
    """Serve a dataset from a thread of its own."""
    runner = web.AppRunner(application(ViewedDataset(root)), access_log=None, shutdown_timeout=0.1)
    loop = asyncio.new_event_loop()

    async def start() -> int:
        await runner.setup()
        await web.TCPSite(runner, HOST, 0).start()
        return int(runner.addresses[0][1])

    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    port = asyncio.run_coroutine_threadsafe(start(), loop).result(20)
    try:
        yield Served(root, port)
    finally:
        asyncio.run_coroutine_threadsafe(runner.cleanup(), loop).result(20)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(20)
        loop.close()
