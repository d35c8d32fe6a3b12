"""What the doctor tries out in a process of its own: a crash there is a finding, and not the end."""

import importlib
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings


@dataclass(frozen=True)
class Outcome:
    """How a trial ended.

    Attributes:
        kind: a value was returned, an exception raised, the process died, or did not answer.
        value: what was returned.
        error: what went wrong, in one line; empty for a value.
        output: the last line that the process printed.
    """

    kind: Literal["value", "error", "crash", "timeout"]
    value: Any = None
    error: str = ""
    output: str = ""


def run_child(function: Callable[..., Any], *arguments: Any, timeout_s: float = 120.0) -> Outcome:
    """Call a function in a spawned process that prints nothing on our terminal.

    Args:
        function: what to call; it must be importable by name.
        arguments: its arguments.
        timeout_s: after this time the process is killed [s].
    """
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        try:
            log = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bhd-doctor-"))) / "output.txt"
        except OSError:  # a full disk is for another check to report
            log = Path(os.devnull)
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_serve, args=(theirs, log, function, arguments), daemon=True)
        process.start()
        theirs.close()  # or the end of the process would not end the pipe
        try:
            if not ours.poll(timeout_s):
                return Outcome("timeout", error=f"no answer in {timeout_s:g} s", output=_last_line(log))
            kind, value = ours.recv()
            process.join(1.0)  # so that it ends by itself
            if kind == "value":
                return Outcome("value", value=value, output=_last_line(log))
            return Outcome("error", error=str(value), output=_last_line(log))
        except EOFError:
            process.join()
            return Outcome("crash", error=_end(process.exitcode), output=_last_line(log))
        finally:
            ours.close()
            process.kill()
            process.join()
            process.close()


def _serve(connection: Connection, log: Path, function: Callable[..., Any], arguments: Sequence[Any]) -> None:
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):  # also what C libraries print
        os.dup2(handle, stream)
    message: tuple[str, Any]
    try:
        message = "value", function(*arguments)
    except BhdError as error:
        message = "error", str(error)
    except Exception as error:
        message = "error", f"{type(error).__name__}: {error}"
    connection.send(message)
    connection.close()


def _last_line(log: Path) -> str:
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    except FileNotFoundError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _end(status: int | None) -> str:
    if status is not None and status < 0:
        names = {one.value: one.name for one in signal.Signals}
        return f"ended by {names.get(-status, f'signal {-status}')}"
    return f"ended with status {status}"


# --- trials ----------------------------------------------------------------------------------------------------------


def render() -> dict[str, Any]:
    """Render one image of a simulation; return the driver's name and how far apart its brightest and darkest are.

    Raises:
        RenderingError: no OpenGL works here.
    """
    from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
    from bhd_lerobot.sim.camera import Camera
    from bhd_lerobot.sim.world import World

    camera = Camera(World(turtlebot3_burger()), 64, 48)
    image = camera.render(0, "front")
    gl = importlib.import_module("OpenGL.GL")
    name = gl.glGetString(gl.GL_RENDERER)
    camera.close()
    return {"spread": int(image.max()) - int(image.min()), "driver": name.decode(errors="replace") if name else "?"}


def encode() -> dict[str, Any]:
    """Encode one image as H.264 into memory; return versions and whether torchcodec could find FFmpeg's libraries."""
    import io
    from ctypes.util import find_library

    import av
    import numpy as np

    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("h264", 10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    version = ".".join(map(str, av.library_versions["libavcodec"]))
    return {
        "bytes": len(file.getvalue()),
        "pyav": av.__version__,
        "libavcodec": version,
        "shared": find_library("avutil"),
    }


def ask_rights(settings: RealtimeSettings) -> list[dict[str, Any]]:
    """Ask for real-time privileges; return what became of each request, as the fields of a `Grant`."""
    with Privileges() as privileges:
        return [grant.as_dict() for grant in privileges.acquire(settings)]


def list_plugins() -> dict[str, list[str]]:
    """Return the types of robots and teleoperators that LeRobot knows after it has looked for plug-ins."""
    from lerobot.robots.config import RobotConfig
    from lerobot.teleoperators.config import TeleoperatorConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    return {
        "robots": sorted(RobotConfig.get_known_choices()),
        "teleoperators": sorted(TeleoperatorConfig.get_known_choices()),
    }
