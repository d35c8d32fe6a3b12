"""`bhd-monitor --3d`: the robot that runs, on the page that `bhd-data view` draws recorded ones on."""

import asyncio
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
from aiohttp import web

from bhd_lerobot.apps.view.geometry import scene_of, views_of
from bhd_lerobot.apps.view.packing import to_json
from bhd_lerobot.apps.view.server import bare_application, listening, page
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.realtime.block import LiveBlock, Word

_PERIOD_S = 1 / 30  # between two states that the page is sent
_ODOMETRY = ("x.pos", "y.pos", "theta.pos")


class LivePage:
    """What the page is sent of a running robot: an episode of one frame, which is the newest."""

    def __init__(self, block: LiveBlock) -> None:
        self._block = block
        self._robot = block.about["robot"]
        self._names: list[str] = list(block.about.get("observations", ()))

    def message(self, seen: int) -> tuple[int, dict[str, Any]]:
        """Return how many scenes there have been, and the newest state as plain values.

        Args:
            seen: how many there had been in the message before, or -1: a scene that did not change is left out.
        """
        block, words = self._block, self._block.words
        count, scene = block.scene
        state: Any = block.ring.latest()
        told: dict[str, Any] = {
            "phase": block.phase.name.lower(),
            "estop": bool(words[Word.ESTOP] != words[Word.ESTOP_ACKNOWLEDGED]),
        }
        if state is None:
            return -1, told
        told["mode"] = Mode(int(state["state"]["mode"])).name.lower().replace("_", " ")
        told["age"] = (time.monotonic_ns() - int(state["sensed_ns"])) / NANOSECONDS
        views, arrays = self._drawn(state)
        told["arrays"] = {
            name: np.round(values[0].ravel().astype(float), 4).tolist() for name, values in arrays.items()
        }
        if count != seen:
            told["about"] = {
                "title": f"{block.name}, {self._robot}",
                "views": views,
                "scene": scene_of({"bhd/scene": scene}),
            }
        return count, told

    def _drawn(self, state: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        names, observed, physics = self._names, state["observation"], state["physics"]
        if not physics.shape[1] and self._block.about.get("drives") and not set(_ODOMETRY) <= set(names):
            odometry = state["state"]["odometry"][None]
            names, observed = [*names, *_ODOMETRY], np.concatenate([observed, odometry], axis=1)
        columns = {keys.OBSERVATION_STATE: observed, **({keys.PHYSICS_STATE: physics} if physics.shape[1] else {})}
        views, places = views_of(self._robot, {keys.OBSERVATION_STATE: {"names": names}}, columns)
        return views, {keys.OBSERVATION_STATE: observed, **{f"view.{name}": values for name, values in places.items()}}


async def _stream(request: web.Request, live: LivePage, end: asyncio.Event) -> web.StreamResponse:
    """Send states as server-sent events, the newest each time, for as long as somebody reads them."""
    response = web.StreamResponse(headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store"})
    await response.prepare(request)
    seen = -1
    with suppress(ConnectionResetError):  # the page was closed
        while not end.is_set():
            seen, message = live.message(seen)
            await response.write(f"data: {to_json(message)}\n\n".encode())
            await asyncio.sleep(_PERIOD_S)
    return response


@contextmanager
def served(block: LiveBlock, port: int) -> Iterator[str]:
    """Serve the page of a running robot, on a thread of its own; yield its address."""
    started: Future[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def work() -> None:
        end, live = asyncio.Event(), LivePage(block)
        app = bare_application()
        app.router.add_get("/", page("live.html"))
        app.router.add_get("/api/live", partial(_stream, live=live, end=end))
        try:
            async with listening(app, port) as address:
                started.set_result((address, asyncio.get_running_loop(), end))
                await end.wait()
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=lambda: asyncio.run(work()), name="bhd-monitor-3d", daemon=True)
    thread.start()
    address, loop, end = started.result()
    try:
        yield address
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join()
