"""Offscreen images of simulations, without a display."""

import os
import sys
import threading
import weakref
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import RenderingError, unknown_name
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.world import World

_BACKENDS = ("egl", "osmesa")
_CHOICES = (*_BACKENDS, "glfw")
_REMEDY = (
    "Images need an offscreen OpenGL: install EGL (Debian and Ubuntu: 'apt-get install libegl1 libgl1', works with and "
    "without a GPU) or OSMesa ('apt-get install libosmesa6'), or turn the cameras off. To choose a backend yourself, "
    "set MUJOCO_GL to 'egl', 'osmesa' or 'glfw'."
)


def _make_context(width: int, height: int) -> Any:
    """Return an OpenGL context from the first backend that works.

    A user's choice in MUJOCO_GL is honoured; otherwise EGL and then OSMesa are tried, which need no display.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen and chosen not in _CHOICES:
        raise RenderingError(f"{unknown_name('MUJOCO_GL backend', chosen, _CHOICES)} {_REMEDY}")
    platform = os.environ.get("PYOPENGL_PLATFORM")
    failures = []
    for backend in (chosen,) if chosen else _BACKENDS:
        try:
            return _open(backend, width, height)
        except Exception as error:  # the GL bindings raise whatever they like: ImportError, AttributeError, GLError
            failures.append(f"{backend}: {type(error).__name__}: {error}")
            _forget_backend(platform)
    raise RenderingError(f"No image can be rendered here. Tried {'; '.join(failures)}. {_REMEDY}")


def _open(backend: str, width: int, height: int) -> Any:
    if backend == "egl":
        from mujoco.egl import GLContext
    elif backend == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco.glfw import GLContext
    return GLContext(width, height)


def _forget_backend(platform: str | None) -> None:
    """Undo what a backend that failed left behind: PyOpenGL binds to one platform when it is first imported."""
    if platform is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)
    for name in list(sys.modules):
        if name.partition(".")[0] == "OpenGL" or name.startswith(("mujoco.egl", "mujoco.osmesa")):
            del sys.modules[name]


class Pose:
    """One simulation's model and state at one time, to be drawn later.

    Args:
        world: the simulations.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.model = world.copy_model(0)
        self.data = mujoco.MjData(world.model)

    def take(self, sim: int) -> None:
        """Take the present pose of a simulation, in place of the one before."""
        self._world.copy_into(sim, self.model, self.data)


class Camera:
    """Renders images of a world's simulations.

    One camera object serves all simulations and all named cameras of one image size, from any thread, one at a time.

    Args:
        world: the simulations.
        width: image width [px].
        height: image height [px].
        alone: nothing else uses OpenGL on this thread, and no other thread uses the camera: the OpenGL context, which
            belongs to one thread at a time, stays bound between images.

    Raises:
        RenderingError: no OpenGL backend works here; the message names the remedy.
    """

    def __init__(self, world: World, width: int = 320, height: int = 240, *, alone: bool = False) -> None:
        self._world = world
        self._must_bind, self._lock = not alone, threading.Lock()
        self.width, self.height = width, height
        self._gl = _make_context(width, height)
        if alone:
            self._gl.make_current()
        with self._bound():
            self._open(world)

    def _open(self, world: World) -> None:
        width, height, model = self.width, self.height, world.model
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._scene = mujoco.MjvScene(model, maxgeom=world.model.ngeom + 64)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self._scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [1, 1, 0, 0, 0, 0]  # obstacles and visuals; the hull is for contacts only
        self._option.sitegroup[:] = 0
        self._view = mujoco.MjvCamera()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except mujoco.FatalError as error:  # GLFW without a display makes a context that is none
            self._gl.free()
            raise RenderingError(f"No image can be rendered here: {error}. {_REMEDY}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # Not at interpreter exit: by then the display connection is gone, and the process frees everything anyway.
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        self._flipped = np.empty((height, width, 3), np.uint8)
        self._own = Pose(world)

    def render(self, sim: int, camera: str, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Return the image that a named camera of one simulation sees now.

        Args:
            sim: the simulation.
            camera: a camera of the body, or ``"overview"``.
            out: where the image goes; a new array if None.

        Returns:
            The image, shape (height, width, 3), RGB, first row on top.

        Raises:
            RenderingError: there is no such camera, or the renderer was closed.
        """
        with self._lock:
            self._own.take(sim)
            return self.draw(self._own, camera, out)

    def _bound(self) -> AbstractContextManager[None]:
        """Bind the OpenGL context to this thread, and free it for others afterwards."""
        if not self._must_bind:
            return nullcontext()
        if hasattr(self._gl, "as_current"):
            return self._gl.as_current()
        self._gl.make_current()  # of MuJoCo 3, whose contexts stay with the thread
        return nullcontext()

    def draw(self, pose: "Pose", camera: str, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Return the image that a named camera sees in a pose that was taken earlier; otherwise like `render`."""
        if self._context is None:
            raise RenderingError("The camera was closed; make a new one.")
        model = self._world.model
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if number < 0:
            raise RenderingError(unknown_name("camera", camera, [model.camera(i).name for i in range(model.ncam)]))
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = number
        mujoco.mj_kinematics(pose.model, pose.data)
        mujoco.mj_camlight(pose.model, pose.data)
        mujoco.mjv_updateScene(
            pose.model, pose.data, self._option, None, self._view, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        with self._bound():
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._flipped, None, self._rect, self._context)
        image = self._flipped[::-1]
        if out is None:
            return image.copy()
        out[:] = image
        return out

    def close(self) -> None:
        """Free the OpenGL context. May be called twice."""
        self._context = None
        self._free()


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    gl.make_current()
    context.free()
    gl.free()
