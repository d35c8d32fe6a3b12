"""What the doctor tries out in a process of its own, where a crash is a finding and not the end.

The latency test runs here, too: nothing at the top of this module imports torch, LeRobot or MuJoCo.
"""

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Literal

from bhd_lerobot.apps.doctor.latency_test import measure
from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings

TIMEOUT_S = 180.0
_RESULT = "\0result "  # stands before the result, after what libraries print


@dataclass(frozen=True)
class Outcome:
    """How a trial ended: a value was returned, an exception raised, the process died, or did not answer.

    ``error`` says what went wrong in one line; ``output`` is the last line that was printed meanwhile.
    """

    kind: Literal["value", "error", "crash", "timeout"]
    value: Any = None
    error: str = ""
    output: str = ""


def run_trials(trials: Sequence[Sequence[Any]], timeout_s: float = TIMEOUT_S) -> list[Outcome]:
    """Try things out, names of `TRIALS` with their arguments; a process that does not end in time [s] is killed."""
    return [_run_process(trial, timeout_s) for trial in trials]


def _run_process(trial: Sequence[Any], timeout_s: float) -> Outcome:
    command = [sys.executable, "-P", "-m", __name__, json.dumps(trial)]
    kind: Literal["crash", "timeout"] = "crash"
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=timeout_s,
            check=False,
        )
        printed, end = done.stdout, _describe_end(done.returncode)
    except subprocess.TimeoutExpired as error:
        kind, printed, end = "timeout", error.stdout or b"", f"no answer in {timeout_s:g} s"
    before, _, result = printed.decode(errors="replace").partition(_RESULT)
    last = next((line.strip() for line in reversed(before.split("\n")) if line.strip()), "")
    return Outcome(**json.loads(result), output=last) if result else Outcome(kind, error=end, output=last)


def _describe_end(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    names = {number.value: number.name for number in signal.Signals}
    return f"ended by {names.get(-status, f'signal {-status}')}"


def main(trial: str) -> None:
    """Run a trial in this process; print its result, after whatever libraries print."""
    name, *arguments = json.loads(trial)
    try:
        result = {"kind": "value", "value": TRIALS[name](*arguments)}
    except BhdError as error:
        result = {"kind": "error", "error": str(error)}
    except Exception as error:
        result = {"kind": "error", "error": f"{type(error).__name__}: {error}"}
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os.write(1, f"\n{_RESULT}{json.dumps(result)}".encode())
    os._exit(0)  # nothing is printed at the exit, and no driver can crash there


def ask_rights() -> list[dict[str, Any]]:
    """Ask for real-time privileges; return the outcome of each request, as the fields of a `Grant`."""
    with Privileges() as privileges:
        return [grant.as_dict() for grant in privileges.acquire(RealtimeSettings())]


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


def render() -> dict[str, Any]:
    """Render one image of a simulation; return the driver's name and how far apart its brightest and darkest are."""
    from bhd_lerobot.bodies.body import Drive
    from bhd_lerobot.bodies.registry import body_with
    from bhd_lerobot.sim.camera import Camera
    from bhd_lerobot.sim.world import World

    body = body_with(Drive)
    camera = Camera(World(body), 64, 48)
    image = camera.render(0, next(iter(body.cameras)))
    gl = importlib.import_module("OpenGL.GL")
    name = gl.glGetString(gl.GL_RENDERER)
    camera.close()
    return {"spread": int(image.max()) - int(image.min()), "driver": name.decode(errors="replace") if name else "?"}


def list_plugins() -> dict[str, list[str]]:
    """Return the types of robots and teleoperators that LeRobot knows after it has searched for plug-ins."""
    from lerobot.cameras.configs import CameraConfig
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.robots.config import RobotConfig
    from lerobot.teleoperators.config import TeleoperatorConfig

    from bhd_lerobot.bodies.registry import BODIES
    from bhd_lerobot.options.plugins import import_plugins, misnamed
    from bhd_lerobot.policies.brain import BrainConfig
    from bhd_lerobot.stock import register_third_party_plugins
    from bhd_lerobot.tasks.task import TaskConfig

    kinds = {
        "robot": RobotConfig,
        "teleoperator": TeleoperatorConfig,
        "camera": CameraConfig,
        "policy": PreTrainedConfig,
        "environment": EnvConfig,
        "task": TaskConfig,
        "brain": BrainConfig,
    }
    known: set[tuple[str, str]] = set()
    registered: dict[str, list[str]] = {}
    failed = [f"The plug-in {name} is not imported: {reason}" for name, reason in misnamed()]
    for name, error in import_plugins():
        if not error:
            registered.setdefault(name, [])
        else:
            failed.append(
                f"The plug-in {name} cannot be imported, and its robots, tasks and brains are missing: {error}"
            )
        for kind, registry in kinds.items():
            for choice, config in registry.get_known_choices().items():
                package = config.__module__.partition(".")[0]
                if (kind, choice) in known or package in ("lerobot", "bhd_lerobot"):
                    continue
                known.add((kind, choice))
                # One plug-in may have imported another.
                registered.setdefault(package if package.startswith("lerobot_") else name, []).append(
                    f"{kind} {choice}"
                )
    register_third_party_plugins()
    return {
        "failed": failed,
        "installed": [f"{_with_version(name)}: {', '.join(has) or 'nothing'}" for name, has in registered.items()],
        "bodies": list(BODIES),
        "robots": sorted(RobotConfig.get_known_choices()),
        "teleoperators": sorted(TeleoperatorConfig.get_known_choices()),
    }


def _with_version(name: str) -> str:
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:  # the module of an entry point
        return name


TRIALS: dict[str, Callable[..., Any]] = {
    "rights": ask_rights,
    "ffmpeg": encode,
    "opengl": render,
    "plug-ins": list_plugins,
    "latency test": measure,
}

if __name__ == "__main__":
    main(sys.argv[1])
