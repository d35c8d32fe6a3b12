"""MuJoCo, imported so that only images depend on OpenGL.

MuJoCo opens the OpenGL backend that MUJOCO_GL names when it is imported, and the import fails if that does not work
or if there is no such backend: on a machine without OpenGL even a simulation that renders nothing could not start. So
it is imported without the variable; `camera.py` reads it when an image is rendered, and reports what is wrong with it.
"""

import os

from bhd_lerobot.versions import check_version

check_version("mujoco")
_chosen = os.environ.pop("MUJOCO_GL", None)
try:
    import mujoco
    from mujoco import batch as mujoco_batch
finally:
    if _chosen is not None:
        os.environ["MUJOCO_GL"] = _chosen

__all__ = ["mujoco", "mujoco_batch"]
