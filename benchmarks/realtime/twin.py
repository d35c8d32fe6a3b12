"""The C++ twin: built with the system's compiler against the MuJoCo that is installed here."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.realtime.cases import PERIOD_NS, PRIORITY, WARM_UP_TICKS, Case, CaseError, run_recorder, ticks_in
from benchmarks.realtime.stage import settled_robot
from benchmarks.realtime.statistics import Samples

_SOURCE = Path(__file__).with_name("twin.cpp")


def find_compiler() -> str:
    """Return the C++ compiler: $CXX, else what the system calls c++, g++ or clang++.

    Raises:
        CaseError: there is none.
    """
    chosen = os.environ.get("CXX", "")
    for name in [chosen] if chosen else ["c++", "g++", "clang++"]:
        found = shutil.which(name)
        if found:
            return found
    if chosen:
        raise CaseError(f"CXX names {chosen!r}, which is no program here")
    raise CaseError("no C++ compiler (Debian and Ubuntu: package g++; or name one in CXX)")


def build(folder: Path) -> Path:
    """Build the twin in a folder and return the program.

    Raises:
        CaseError: there is no compiler, or it does not compile.
    """
    if not sys.platform.startswith("linux"):
        raise CaseError(f"the C++ twin is for Linux, this is {sys.platform}")
    spec = find_spec("mujoco")
    assert spec is not None
    assert spec.origin is not None
    library = Path(spec.origin).parent
    shared = sorted(library.glob("libmujoco.so*"))
    if not shared or not (library / "include" / "mujoco" / "mujoco.h").is_file():
        raise CaseError(f"the installed mujoco {mujoco.__version__} has no headers or no shared library")
    program = folder / "twin"
    command = [find_compiler(), "-O2", "-std=c++17", "-pthread", f"-I{library / 'include'}", str(_SOURCE)]
    command += [str(shared[0]), f"-Wl,-rpath,{library}", "-o", str(program)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["(it said nothing)"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise CaseError(f"{Path(command[0]).name} does not compile the C++ twin: {first.strip()}")
    return program


def save_model(path: Path) -> None:
    """Save the model that the benchmark's robots step, in the same scene, with its state as the first keyframe."""
    world = settled_robot(round(1e9 / PERIOD_NS)).world
    model = world.copy_model(0)
    model.key_qpos[0], model.key_qvel[0], model.key_ctrl[0] = world.qpos[0], world.qvel[0], world.ctrl[0]
    mujoco.mj_saveModel(model, str(path), None)


def twin_case(folder: Path) -> Case:
    """Build the C++ twin and return it as a case.

    Args:
        folder: where program, model and records go.

    Raises:
        CaseError: it cannot be built.
    """
    program, model, out = build(folder), folder / "ur5.mjb", folder / "twin.records"
    save_model(model)

    def run(seconds: float) -> Samples:
        numbers = (str(n) for n in (PERIOD_NS, ticks_in(seconds), WARM_UP_TICKS, PRIORITY))
        samples = run_recorder([str(program), str(model), str(out), *numbers], out, seconds)
        if np.any(samples.wake_ns < 0):
            raise CaseError("the C++ twin woke before it was due: its clock is not the one it is measured with")
        return samples

    return Case("twin", "C++ twin", run)
