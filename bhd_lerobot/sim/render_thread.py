"""Images made while the simulation continues."""

import queue
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.sim.camera import Camera, Pose
from bhd_lerobot.sim.world import World

Deliver = Callable[[NDArray[np.uint8]], None]
"""Takes an image, shape (height, width, 3)."""


class RenderThread:
    """Renders on a thread of its own: `submit` takes the pose and returns at once.

    Rendering a frame takes longer than the physics of the frame, and neither needs the interpreter meanwhile.
    Images are made and delivered in the order of the calls, and none is dropped: when `depth` of them wait, `submit`
    waits too.

    Args:
        world: the simulations.
        width: image width [px].
        height: image height [px].
        depth: images that may wait.

    Raises:
        RenderingError: no image can be rendered here.
    """

    def __init__(self, world: World, width: int, height: int, depth: int = 8) -> None:
        self._poses: queue.Queue[Pose] = queue.Queue()
        for _ in range(depth):
            self._poses.put(Pose(world))
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="render")
        try:
            # The OpenGL context belongs to the thread that makes it.
            self._camera: Camera = self._executor.submit(Camera, world, width, height, alone=True).result()
        except BaseException:
            self._executor.shutdown()
            raise

    def submit(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Ask for the image that a named camera of a simulation sees now.

        Args:
            sim: the simulation.
            camera: the camera.
            deliver: called with the image, on the render thread; what it raises is raised by the future.

        Returns:
            The image to come, shape (height, width, 3).
        """
        pose = self._poses.get()
        pose.take(sim)
        return self._executor.submit(self._render, pose, camera, deliver)

    def _render(self, pose: Pose, camera: str, deliver: Deliver | None) -> NDArray[np.uint8]:
        try:
            image = self._camera.draw(pose, camera)
        finally:
            self._poses.put(pose)
        if deliver is not None:
            deliver(image)
        return image

    def close(self) -> None:
        """Finish what waits, and free the renderer. May be called twice."""
        try:
            self._executor.submit(self._camera.close).result()
        except RuntimeError:  # closed before
            return
        self._executor.shutdown()
