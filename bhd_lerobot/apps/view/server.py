"""The web server of `bhd-data view`: the page, the dataset as the page wants it, and the videos.

`bare_application`, `page` and `listening` serve other pages of the same parts, see `bhd-monitor --3d`.
"""

import asyncio
import os
import re
import signal
import sys
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from aiohttp import web
from aiohttp.typedefs import Handler

from bhd_lerobot.apps.view.dataset import ViewedDataset, stamp_of
from bhd_lerobot.apps.view.guard import add_headers, guard, new_token
from bhd_lerobot.apps.view.packing import to_json
from bhd_lerobot.errors import BhdError, ConfigError

HOST = "127.0.0.1"
STATIC = Path(__file__).parent / "static"
_DATASET: web.AppKey[ViewedDataset] = web.AppKey("dataset", ViewedDataset)
_TOKEN: web.AppKey[str] = web.AppKey("token", str)
_NUMBER = re.compile(r"[0-9]{1,9}")


def bare_application() -> web.Application:
    """Return a server of the parts that pages are made of, and of no page."""
    token = new_token()
    app = web.Application(middlewares=[guard(token), _respond_to_errors], client_max_size=64 * 1024)
    app[_TOKEN] = token
    app.on_response_prepare.append(add_headers)
    app.router.add_get("/favicon.ico", _no_icon)
    app.router.add_static("/static", STATIC)
    return app


def application(dataset: ViewedDataset) -> web.Application:
    """Return the server of a dataset."""
    app = bare_application()
    app[_DATASET] = dataset
    app.router.add_get("/", page("index.html"))
    app.router.add_get("/api/dataset", _dataset)
    app.router.add_get("/api/stamp", _stamp)
    app.router.add_get("/api/episodes/{index}", _episode)
    app.router.add_post("/api/episodes/{index}/mark", _mark)
    app.router.add_get("/api/episodes/{index}/episode.csv", _download)
    app.router.add_get("/api/episodes/{index}/videos/{key}.mp4", _download)
    app.router.add_get("/api/episodes/{index}/images/{key}/{frame}", _image)
    app.router.add_get("/videos/{key}/{chunk}/{file}.mp4", _video)
    return app


@asynccontextmanager
async def listening(app: web.Application, port: int) -> AsyncIterator[str]:
    """Serve an application on this machine alone, on any free port if 0; yield its address."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port is {port}; it must be between 0 and 65535. 0 takes any that is free.")
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, HOST, port).start()
        except OSError as error:
            raise ConfigError(
                f"--port {port}: nothing can be served there on {HOST} ({error.strerror or error}). "
                "Choose another port, or --port 0 for any that is free."
            ) from error
        yield f"http://{HOST}:{runner.addresses[0][1]}/"
    finally:
        await runner.cleanup()


async def serve(dataset: ViewedDataset, port: int, ready: Callable[[str], None]) -> signal.Signals:
    """Serve the page of a dataset until SIGINT or SIGTERM; return which it was.

    Args:
        ready: is called with the page's address as soon as it can be opened.
    """
    loop = asyncio.get_running_loop()
    stop: asyncio.Future[signal.Signals] = loop.create_future()
    signals = (signal.SIGINT, signal.SIGTERM)

    def end(number: signal.Signals) -> None:
        if not stop.done():
            stop.set_result(number)

    try:
        for number in signals:
            loop.add_signal_handler(number, end, number)
        async with listening(application(dataset), port) as address:
            ready(address)
            return await stop
    finally:
        for number in signals:
            loop.remove_signal_handler(number)


def open_browser(address: str) -> None:
    """Open a page where a browser comes up in a window; a text browser would take the terminal."""
    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(address)


def page(name: str) -> Handler:
    """Return what answers with a page of the folder `static`."""

    async def answer(request: web.Request) -> web.Response:
        text = (STATIC / name).read_text(encoding="utf-8").replace("{{token}}", request.app[_TOKEN])
        return web.Response(text=text, content_type="text/html", headers={"Cache-Control": "no-store"})

    return answer


@web.middleware
async def _respond_to_errors(request: web.Request, handler: Any) -> web.StreamResponse:
    """Send the page the message that a terminal would show."""
    try:
        response: web.StreamResponse = await handler(request)
    except BhdError as error:
        return web.json_response({"error": str(error)}, status=409)
    return response


async def _no_icon(request: web.Request) -> web.Response:
    return web.Response(status=204)


async def _dataset(request: web.Request) -> web.Response:
    dataset = request.app[_DATASET]
    await asyncio.to_thread(dataset.reload)
    text = await asyncio.to_thread(lambda: to_json(dataset.summary()))
    response = web.Response(text=text, content_type="application/json")
    response.enable_compression()
    return response


async def _stamp(request: web.Request) -> web.Response:
    dataset = request.app[_DATASET]
    now = await asyncio.to_thread(stamp_of, dataset.root)
    return web.json_response({"shown": dataset.stamp, "now": now})


async def _episode(request: web.Request) -> web.Response:
    dataset = request.app[_DATASET]
    etag = f'"{dataset.stamp}-{request.app[_TOKEN][:8]}"'  # another server's packing may be another one
    if request.headers.get("If-None-Match") == etag:
        return web.Response(status=304, headers={"ETag": etag})
    packed = await asyncio.to_thread(dataset.packed, _number(request, "index"), _shown(request))
    return web.Response(body=packed, content_type="application/octet-stream", headers={"ETag": etag})


async def _video(request: web.Request) -> web.StreamResponse:
    slot = _number(request, "chunk"), _number(request, "file")
    path = request.app[_DATASET].video(request.match_info["key"], slot)
    if path is None:
        raise web.HTTPNotFound(text="There is no such video.\n")
    return web.FileResponse(path, headers={"Content-Type": "video/mp4"})  # it knows ranges and conditions


async def _download(request: web.Request) -> web.Response:
    dataset, index, key = request.app[_DATASET], _number(request, "index"), request.match_info.get("key")
    content = await asyncio.to_thread(dataset.download, index, key, _shown(request))
    if content is None:
        raise web.HTTPNotFound(text="There is no such video.\n")
    kind = "text/csv" if key is None else "video/mp4"
    return web.Response(body=content, content_type=kind, headers={"Content-Disposition": "attachment"})


async def _image(request: web.Request) -> web.Response:
    dataset, key = request.app[_DATASET], request.match_info["key"]
    index, frame = _number(request, "index"), _number(request, "frame")
    content = await asyncio.to_thread(dataset.image, index, key, frame, _shown(request))
    if content is None:
        raise web.HTTPNotFound(text="There is no such image.\n")
    kind = "image/png" if content.startswith(b"\x89PNG") else "image/jpeg"
    return web.Response(body=content, content_type=kind)


async def _mark(request: web.Request) -> web.Response:
    dataset, index = request.app[_DATASET], _number(request, "index")
    try:
        wanted = await request.json()
    except ValueError as error:
        raise web.HTTPBadRequest(text=f"The request is not JSON: {error}\n") from error
    await asyncio.to_thread(dataset.mark, index, wanted, _shown(request))
    return web.json_response({"stamp": dataset.stamp})


def _shown(request: web.Request) -> str | None:
    """Return the stamp of what the asking page shows; None if it does not say so."""
    return request.query.get("stamp")


def _number(request: web.Request, name: str) -> int:
    text = request.match_info[name]
    if not _NUMBER.fullmatch(text):
        raise web.HTTPNotFound(text=f"{name} is {text[:40]!r}; it must be a whole number.\n")
    return int(text)
