"""The images of running episodes: ordered when a frame begins, delivered while it runs."""

from collections.abc import Callable, Mapping
from concurrent import futures
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.robots.host.robots import Robots

Image = NDArray[np.uint8]
Observer = Callable[[int, Mapping[str, Any]], None]
"""Is shown a frame: the simulation, and its columns so far by key; or an image, under its camera's key. Must not wait,
and copy what it keeps; images come on another thread."""


class EpisodeImages:
    """Orders images of n simulations, and hands each to what takes those of its episode, or to nothing."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self.sinks: list[Any] = [None] * robots.n
        self._pending: list[list[futures.Future[Image]]] = [[] for _ in range(robots.n)]

    def order_all(self, observer: Observer | None, wanted: NDArray[np.bool_]) -> dict[str, Image]:
        """Order the images of the running simulations that anybody looks at; return those wanted, others black.

        A brain that does not use images does not wait for them: they are made while the frame continues.
        """
        robots, shapes = self._robots, self._robots.camera_shapes
        cameras = list(shapes)
        images: dict[str, Image] = {}
        running = np.flatnonzero(robots.running).tolist() if cameras else []
        for sim in running:
            if wanted[sim] or observer is not None or self.sinks[sim] is not None:
                self._order(sim, observer)
        if wanted.any():
            images = {camera: np.zeros((robots.n, *shape), np.uint8) for camera, shape in shapes.items()}
            for sim in running:
                if wanted[sim]:
                    for camera, image in zip(cameras, self._pending[sim][-len(cameras) :], strict=True):
                        images[camera][sim] = image.result()
        # What went wrong in the making of an image ends the run now, not at the end of the episode.
        for waiting in self._pending:
            while waiting and waiting[0].done():
                waiting.pop(0).result()
        return images

    def _order(self, sim: int, observer: Observer | None) -> None:
        """Order the images of what one simulation shows now."""
        sink = self.sinks[sim]
        for camera in self._robots.camera_shapes:
            key = f"{keys.OBSERVATION_IMAGES}.{camera}"
            deliver = None if sink is None else partial(sink.add_image, key)
            image = self._robots.render_later(sim, camera, deliver)
            self._pending[sim].append(image)
            if observer is not None:
                image.add_done_callback(partial(_show, observer, sim, key))

    def finish(self, sim: int) -> Any:
        """Wait for the images of an episode; return where they went."""
        while self._pending[sim]:
            self._pending[sim].pop(0).result()
        sink, self.sinks[sim] = self.sinks[sim], None
        return sink

    def drop(self, sim: int) -> None:
        """Drop the images of one episode that is running."""
        futures.wait(self._pending[sim])
        self._pending[sim].clear()
        sink, self.sinks[sim] = self.sinks[sim], None
        if sink is not None:
            sink.discard()

    def discard(self) -> None:
        """Drop the images of all episodes that are running."""
        for sim in range(len(self.sinks)):
            self.drop(sim)


def _show(observer: Observer, sim: int, key: str, image: futures.Future[Image]) -> None:
    if not image.cancelled() and image.exception() is None:
        observer(sim, {key: image.result()})
