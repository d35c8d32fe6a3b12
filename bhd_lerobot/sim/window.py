"""MuJoCo's own viewer, on a display."""

import os

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.camera import Pose
from bhd_lerobot.sim.engine import mujoco
from bhd_lerobot.sim.world import World

_DISTANCE = {True: 5.0, False: 2.2}  # [m] from which a base's surroundings, and an arm, are seen
_ARM = (0.25, 0.0, 0.2)  # what is looked at of an arm [m]


def require_display() -> None:
    """Raise if no window can be opened here.

    Raises:
        ConfigError: names the display, and what shows a robot without one.
    """
    causes = ["GLFW cannot be initialised"]
    try:
        import glfw

        before = glfw.set_error_callback(lambda code, text: causes.append(os.fsdecode(text)))
        is_there = glfw.init()
        glfw.set_error_callback(before)  # type: ignore[arg-type]  # None: its own
        if is_there:
            glfw.terminate()
            return
    except ImportError as error:
        causes.append(str(error))
    raise ConfigError(
        f"--view=true opens a window, and there is no display here ({causes[-1].rstrip('.')}). Leave --view out, and "
        "watch a robot on the wall clock (--robot.clock=realtime) in a browser: bhd-monitor --3d."
    )


class Window:
    """Shows one simulation in MuJoCo's viewer: what it was put into at the last `show`.

    It has a model and a state of its own: nothing that is done in the window changes the simulation.

    MuJoCo opens the window on a thread of its own, and waits for ever for one that cannot be opened: the caller is to
    handle what that thread raises, with `threading.excepthook`.

    Args:
        world: the simulations, of which it shows the first.
    """

    def __init__(self, world: World) -> None:
        from mujoco import viewer

        self._pose = Pose(world)
        self._pose.take(0)
        self._viewer = viewer.launch_passive(self._pose.model, self._pose.data, show_left_ui=False, show_right_ui=False)
        with self._viewer.lock():
            self._viewer.opt.geomgroup[:] = [1, 1, 0, 0, 0, 0]  # as the cameras see it
            self._viewer.opt.sitegroup[:] = 0
            is_base = world.body.drive is not None
            self._viewer.cam.lookat[:] = (0.0, 0.0, 0.0) if is_base else _ARM
            self._viewer.cam.distance = _DISTANCE[is_base]

    @property
    def is_open(self) -> bool:
        """Whether nobody has closed the window."""
        return bool(self._viewer.is_running())

    def show(self) -> None:
        """Show the simulation as it is now."""
        with self._viewer.lock():
            self._pose.take(0)
            mujoco.mj_forward(self._pose.model, self._pose.data)
        self._viewer.sync()
