"""A video and an image of a recorded episode, rendered from its recorded physics states."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim.camera import Camera

WIDTH, HEIGHT = 640, 480
FPS = 20
STRIP = 2, 3  # rows and columns of the image
GAP = 8  # between them [px]


class Preview:
    """Renders episodes from outside. Making one fails early where no image can be rendered."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._camera = Camera(simulation.world, WIDTH, HEIGHT)

    def image(self, scene: Any, state: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the scene in one recorded state, shape (HEIGHT, WIDTH, 3)."""
        self._simulation.place(np.zeros(1, np.intp), [scene])
        self._show(state)
        return self._camera.render(0, self._simulation.view)

    def write(self, scene: Any, states: NDArray[np.float64], fps: int, path: Path) -> None:
        """Write an episode's video, at its frames a second [Hz], of its physics states, shape (frames, nq + nv)."""
        import av  # a run without a video does not need FFmpeg

        self._simulation.place(np.zeros(1, np.intp), [scene])
        # Every video frame shows the recorded frame nearest to its time.
        frames = np.arange(0, len(states), fps * self._simulation.video_speed / FPS).round().astype(int)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("h264", rate=Fraction(FPS), options={"crf": "24", "preset": "veryfast"})
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            for index in frames[frames < len(states)]:
                self._show(states[index])
                image = self._camera.render(0, self._simulation.view)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())

    def write_strip(self, scene: Any, states: NDArray[np.float64], fps: int, path: Path) -> None:
        """Write an image of some of an episode's frames, evenly spaced, in rows, each with its time."""
        from PIL import Image, ImageDraw

        self._simulation.place(np.zeros(1, np.intp), [scene])
        images = []
        for index in np.linspace(0, len(states) - 1, STRIP[0] * STRIP[1]).round().astype(int):
            self._show(states[index])
            image = Image.fromarray(self._camera.render(0, self._simulation.view))
            draw, label, corner = ImageDraw.Draw(image), f"{index / fps:.1f} s", (20, 14)
            left, top, right, bottom = draw.textbbox(corner, label, font_size=26)
            draw.rounded_rectangle((left - 10, top - 8, right + 10, bottom + 8), 8, fill="white")
            draw.text(corner, label, fill="black", font_size=26)
            images.append(image)
        strip = Image.new("RGB", ((WIDTH + GAP) * STRIP[1] - GAP, (HEIGHT + GAP) * STRIP[0] - GAP), "white")
        for number, image in enumerate(images):
            strip.paste(image, (number % STRIP[1] * (WIDTH + GAP), number // STRIP[1] * (HEIGHT + GAP)))
        strip.save(path)

    def _show(self, state: NDArray[np.float64]) -> None:
        world = self._simulation.world
        nq = world.qpos.shape[1]
        world.qpos[0], world.qvel[0] = state[:nq], state[nq:]

    def close(self) -> None:
        """Free the renderer."""
        self._camera.close()
