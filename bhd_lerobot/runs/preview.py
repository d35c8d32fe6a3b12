"""An MP4 of a recorded episode, rendered from its recorded physics states."""

from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.body import Body
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.world import World

WIDTH, HEIGHT = 640, 480
SPEED = 4  # times faster than it was
FPS = 20


class Preview:
    """Renders episodes from outside. Making one fails early where no image can be rendered.

    Args:
        body: the robot.

    Raises:
        RenderingError: no image can be rendered here.
    """

    def __init__(self, body: Body) -> None:
        self._world = World(body)
        self._camera = Camera(self._world, WIDTH, HEIGHT)

    def image(self, arena: Arena, state: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the scene in one recorded state, shape (HEIGHT, WIDTH, 3)."""
        self._world.place([arena.shapes])
        self._show(state)
        return self._camera.render(0, "overview")

    def write(self, arena: Arena, states: NDArray[np.float64], fps: int, path: Path) -> None:
        """Write the film of an episode.

        Args:
            arena: the obstacles.
            states: recorded physics states, shape (frames, nq + nv).
            fps: recorded frames a second [Hz].
            path: the MP4 file.
        """
        import av  # a run without a film does not need FFmpeg

        self._world.place([arena.shapes])
        # Every film frame shows the recorded frame nearest to its time.
        frames = np.arange(0, len(states), fps * SPEED / FPS).round().astype(int)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("h264", rate=Fraction(FPS), options={"crf": "24", "preset": "veryfast"})
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            for index in frames[frames < len(states)]:
                self._show(states[index])
                image = self._camera.render(0, "overview")
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())

    def _show(self, state: NDArray[np.float64]) -> None:
        nq = self._world.qpos.shape[1]
        self._world.qpos[0], self._world.qvel[0] = state[:nq], state[nq:]

    def close(self) -> None:
        """Free the renderer."""
        self._camera.close()
