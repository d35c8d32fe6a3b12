"""Compiled loops: the same bits as plain Python, whoever compiles them, and never inside a tick."""

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bhd_lerobot.control.base.diff_drive import DiffDrive, integrate

import bhd_lerobot
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control import kernels
from bhd_lerobot.control.kernels import Kernel
from bhd_lerobot.control.plant import PlantReading
from tests.control.test_wire import arm, base_rig, twist_rig

ROOT = Path(bhd_lerobot.__file__).parents[1]
KERNELS = {
    value.function.__name__: value
    for path in sorted((ROOT / "bhd_lerobot" / "control").rglob("*.py"))
    if "@kernel(\n" in path.read_text() or '@kernel("' in path.read_text()
    for value in vars(importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))).values()
    if isinstance(value, Kernel) and value.signature
}
SPECIAL = (0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e300, 1e-300)


def drawn(kind: str, rng: np.random.Generator) -> Any:
    """Return an argument of a type in numba's words, large enough for two robots with up to six values."""
    name, _, dimensions = kind.partition("[")
    shape = (2, 2, 6)[-1 - dimensions.count(",") :] if dimensions else ()
    if name in ("i8", "i1"):
        return rng.integers(-1, 3, shape).astype(name) if shape else int(rng.integers(-1, 2))
    if name == "b1":
        return rng.random(shape) < 0.5 if shape else bool(rng.random() < 0.5)
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 2, shape)
    values = np.where(rng.random(shape) < 0.1, rng.choice(SPECIAL, shape), values)
    return values if shape else np.float64(values)


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_compiled_and_as_plain_python_it_writes_the_same_bits(name: str) -> None:
    one = KERNELS[name]
    kinds = re.findall(r"\w+(?:\[[^\]]*\])?", one.signature.partition("(")[2])
    rng = np.random.default_rng(0)
    for _ in range(100):
        plain = [drawn(kind, rng) for kind in kinds]
        compiled = [value.copy() if isinstance(value, np.ndarray) else value for value in plain]
        with np.errstate(all="ignore"):
            assert one(*plain) == one.compiled(*compiled)
        for k, (mine, other) in enumerate(zip(plain, compiled, strict=True)):
            np.testing.assert_array_equal(mine, other, err_msg=f"argument {k}")
            signs = (np.signbit(value) | np.isnan(value) for value in (mine, other))  # IEEE 754: NaN has none
            np.testing.assert_array_equal(*signs, err_msg=f"argument {k}")


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile kernels when they are bound."""
    monkeypatch.setattr(kernels, "_values", 1)
    kernels.compile_at_once()


@pytest.mark.parametrize("make", [base_rig, twist_rig, arm])
@pytest.mark.usefixtures("eager")
def test_a_tick_of_a_loop_on_the_wall_clock_compiles_nothing(make: Callable[[], Any]) -> None:
    from numba.core.event import install_recorder

    rig = make()
    with install_recorder("numba:compile") as record:
        rig.tick(50)
        rig.cerebellum.estop.press()
        rig.tick(50)
        rig.cerebellum.take_flags()
    assert record.buffer == []


def test_a_kernel_takes_no_other_types_than_it_was_compiled_for() -> None:
    good = [np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 3))]
    for position in range(3):
        for bad in (np.zeros((1, 3), np.float32), np.zeros(3)):
            arrays = [bad if k == position else one for k, one in enumerate(good)]
            with pytest.raises(TypeError, match="No matching definition"):
                integrate.compiled(*arrays, 1.0, 1.0, 1.0)
            with pytest.raises(TypeError, match=f"Argument {position} of integrate is an array of"):
                Kernel(integrate.function, integrate.signature).bind()(*arrays, 1.0, 1.0, 1.0)


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the kernels that are compiled from now on; they stay Python."""
    names: list[str] = []

    def compiled(one: Kernel[..., Any]) -> Callable[..., Any]:
        names.append(one.function.__name__)
        return one.function

    monkeypatch.setattr(Kernel, "compiled", property(compiled))
    for one in KERNELS.values():
        monkeypatch.delitem(vars(one), "compiled", raising=False)
    monkeypatch.setattr(kernels, "_values", 60)
    return names


def drive(ticks: int) -> None:
    base = DiffDrive(turtlebot3_burger().drive, 3)
    for tick in range(ticks):
        base.update_odometry(np.full((3, 2), 0.1 * tick))


def test_a_kernel_is_compiled_once_it_has_run_for_long(compilations: list[str]) -> None:
    drive(10)  # of three robots
    assert compilations == []
    drive(12)
    assert compilations == ["integrate"]
    with kernels.never_compiled():
        drive(12)
    assert compilations == ["integrate"]
    kernels.compile_at_once()
    drive(0)
    assert compilations == ["integrate", "integrate"]


def test_arrays_of_a_reading_are_not_replaced() -> None:
    reading = PlantReading(1, 2)
    reading.has_effort, reading.stamp_ns = True, np.zeros(1, np.int64)
    reading.position += 1.0
    assert reading.values[0].tolist() == [[1.0, 1.0]]
    with pytest.raises(
        TypeError, match=r"PlantReading.position is not to be replaced: write into it, out.position\[:\]"
    ):
        reading.position = np.zeros((1, 3))


def start(cache: Path, **environment: str) -> subprocess.Popen:
    program = (
        "import numpy as np\n"
        "from bhd_lerobot.control.base.diff_drive import integrate\n"
        "odometry = np.zeros((1, 3))\n"
        "integrate.compiled(np.ones((1, 2)), np.zeros((1, 2)), odometry, 651.9, 2.5e-5, 3.2e-4)\n"
        "print(odometry.tolist())\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, "XDG_CACHE_HOME": str(cache), **environment},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_processes_that_start_together_with_an_empty_cache_fill_it_once(tmp_path: Path) -> None:
    outputs = [one.communicate() for one in [start(tmp_path) for _ in range(2)]]
    assert len({out for out, _ in outputs}) == 1
    assert outputs[0][0].startswith("[[0.03")
    assert all("Compiling the control loop" in err for _, err in outputs)
    assert start(tmp_path).communicate() == (outputs[0][0], "")  # it is loaded


@pytest.mark.thorough
def test_without_a_cache_folder_it_compiles_and_as_plain_python_it_does_not(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    out, err = start(tmp_path / "file").communicate()
    assert (out[:6], err.count("\n")) == ("[[0.03", 1)
    assert start(tmp_path / "file", NUMBA_DISABLE_JIT="1").communicate() == (out, "")
