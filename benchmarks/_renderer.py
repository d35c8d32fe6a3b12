"""Our camera beside MuJoCo's own renderer in its fastest settings, on the same scene."""

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

# MuJoCo's renderer takes its backend from here when it is imported; ours looks for one by itself.
os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np

from bhd_lerobot.sim.camera import Camera

Move = Callable[[np.ndarray, int], None]
"""Moves the joints, shape (nq,), to where they are in a frame."""


class BareRenderer:
    """MuJoCo's own renderer on the scene of an episode.

    Args:
        simulation: in a scene.
        size: height and width of the images [px].
        move: moves what is seen.
    """

    def __init__(self, simulation: Any, size: tuple[int, int], move: Move) -> None:
        self._model, self._move = simulation.world.copy_model(0), move
        self._data = mujoco.MjData(self._model)
        simulation.world.copy_into(0, self._model, self._data)
        self.renderer = mujoco.Renderer(self._model, *size)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self.renderer.scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [1, 1, 0, 0, 0, 0]

    def images(self, cameras: Sequence[str], frame: int) -> list[np.ndarray]:
        """Return the images of a frame."""
        self._move(self._data.qpos, frame)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        images = []
        for name in cameras:
            self.renderer.update_scene(self._data, name, self._option)
            images.append(self.renderer.render())
        return images


def speeds(simulation: Any, size: tuple[int, int], cameras: Sequence[str], move: Move, frames: int) -> dict[str, list]:
    """Return images a second of our camera and of MuJoCo's own renderer, taken in turns, frame by frame."""
    camera, peer = Camera(simulation.world, size[1], size[0]), BareRenderer(simulation, size, move)
    found: dict[str, list[float]] = {"ours": [], "MuJoCo's renderer": []}
    for frame in range(-1, frames):  # the first is not counted
        started = time.perf_counter()
        move(simulation.world.qpos[0], frame)
        for name in cameras:
            camera.render(0, name)
        between = time.perf_counter()
        peer.images(cameras, frame)
        ended = time.perf_counter()
        if frame >= 0:
            for values, took in zip(found.values(), (between - started, ended - between), strict=True):
                values.append(len(cameras) / took)
    camera.close()
    peer.renderer.close()
    return found
