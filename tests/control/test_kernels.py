"""Compiled loops: the same bits as plain Python, whoever compiles them, and never inside a tick."""

import ast
import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
import pytest

import bhd_lerobot
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control import kernels
from bhd_lerobot.control.arm import setpoints, spring
from bhd_lerobot.control.arm.step import Stage
from bhd_lerobot.control.drive import BaseController, read_odometry
from bhd_lerobot.control.kernels import Kernel
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import ArmRecords, RobotRecords
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


# What comes from outside of the core, or from a controller that is broken: any number may be in it.
OUTSIDE = {"position", "velocity", "effort", "actuators", "requested", "target", "values", "near"}
POSITIVE = {"deceleration", "reach", "range_min", "range_max", "largest"}
TIMES = (0, 1, 10**6, 10**9, -(10**9), 2**62, -(2**62), 2**63 - 1, -(2**63))
FIXED = {"limits", "arm_limits", "geometry"}  # numbers of a body
WHOLE = {  # the smallest and the largest; others are from 0 to 3
    "mode": (0, 8),
    "arm_values": (0, 7),
    "width": (2, 8),
    "dof": (1, 8),
    "frame_ticks": (1, 4),
    "late": (1, 5),
    "gyro": (-1, 6),
    "beams": (0, 7),
    "count": (0, 40),
    "next_entry": (0, 256),
    "ticks": (3, 9),
    "relief_period": (1, 4),
    "refusals": (0, 99),
}


def floats(shape: Any, rng: np.random.Generator, *, special: bool = True) -> Any:
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 2, shape)
    return np.where(rng.random(shape) < 0.1, rng.choice(SPECIAL, shape), values) if special else values


def records(name: str, rng: np.random.Generator) -> Any:
    """Return two records, or one of limits, that a core may come to; a queue holds whatever another process wrote."""
    n = 1 if name in FIXED else 2
    made = np.zeros(n, kernels.RECORDS[name])
    if name == "queue" and rng.random() < 0.3:
        return np.frombuffer(rng.bytes(made.nbytes), made.dtype).copy()
    for field in made.dtype.names or ():
        shape, kind = made[field].shape, made[field].dtype.kind
        if kind == "f":
            values = floats(shape, rng, special=field in OUTSIDE)
            made[field] = np.abs(values) + 1e-3 if name in FIXED or field in POSITIVE else values
        elif kind == "b":
            made[field] = rng.random(shape) < 0.5
        elif field.endswith("_ns") or field == "sequence":
            made[field] = rng.choice(TIMES[: None if name == "queue" or field == "stamp_ns" else 5], shape)
        else:
            made[field] = rng.integers(*WHOLE.get(field, (0, 3)), shape)
    if name == "limits":
        made["joints"] = made["arm_values"] + 2
    if name == "queue":
        made["tail"] = rng.choice(TIMES, n)
        with np.errstate(over="ignore"):
            made["head"] = made["tail"] + rng.choice([0, 1, 5, 256, 300, -1, 2**62, -(2**63)], n)
    return made


class Kind:
    """A type of an argument in numba's words."""

    def __init__(self, name: str, dimensions: int = 0) -> None:
        self.name, self.dimensions = name, dimensions

    def __getitem__(self, axes: slice | tuple[slice, ...]) -> "Kind":
        return Kind(self.name, len(axes) if isinstance(axes, tuple) else 1)

    def __call__(self, *fields: Any) -> Any:
        return kernels.TUPLES[self.name]._make(fields) if self.name in kernels.TUPLES else fields  # type: ignore[attr-defined]


class Kinds(dict):
    """Every name is a type."""

    def __missing__(self, name: str) -> Kind:
        return Kind(name)


def drawn(kind: Any, rng: np.random.Generator) -> Any:
    """Return an argument of a type, large enough for two robots with up to six values."""
    if isinstance(kind, tuple):
        made = [drawn(one, rng) for one in kind]
        if isinstance(kind, RobotRecords):  # the words of emergency stops
            made[2] = drawn_array("i8", (3, 2), rng)
        elif isinstance(kind, ArmRecords):
            made[3] = drawn_array("f8", (2, 3, 8), rng)
        return type(kind)(*made)  # type: ignore[arg-type]
    if kind.name == "none":
        return None
    if kind.name in kernels.RECORDS:
        return records(kind.name, rng)
    shape = (2, 2, 6)[-kind.dimensions :] if kind.dimensions else ()
    if kind.name == "float64" and kind.dimensions:  # room for any arm
        shape = (19, 8)[-kind.dimensions :]
    return drawn_array(kind.name, shape, rng)


def drawn_array(name: str, shape: tuple[int, ...], rng: np.random.Generator) -> Any:
    if name in ("i8", "i1"):
        return rng.integers(-1, 3, shape).astype(name) if shape else int(rng.integers(-1, 2))
    if name == "b1":
        return rng.random(shape) < 0.5 if shape else bool(rng.random() < 0.5)
    values = floats(shape, rng)
    return values if shape else np.float64(values)


def copied(value: Any) -> Any:
    if isinstance(value, tuple):
        return type(value)(*map(copied, value))  # type: ignore[arg-type]
    return value.copy() if isinstance(value, np.ndarray) else value


def assert_same(one: Any, other: Any, what: str) -> None:
    if isinstance(one, tuple):
        for name, mine, its in zip(one._fields, one, other, strict=True):  # type: ignore[attr-defined]
            assert_same(mine, its, f"{what}: {name}")
        return
    if one is None:
        return
    one, other = np.asarray(one), np.asarray(other)
    if one.dtype.names:
        for name in one.dtype.names:
            assert_same(one[name], other[name], f"{what}: {name}")
        return
    np.testing.assert_array_equal(one, other, err_msg=what)
    signs = (np.signbit(value) | np.isnan(value) for value in (one, other))  # IEEE 754: NaN has none
    np.testing.assert_array_equal(*signs, err_msg=what)


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_compiled_and_as_plain_python_it_writes_the_same_bits(name: str) -> None:
    one = KERNELS[name]
    kinds = eval(one.signature, {}, Kinds())
    rng = np.random.default_rng(0)
    for _ in range(10 if name == "find_posture" else 40):  # which takes many steps
        plain = [drawn(kind, rng) for kind in kinds]
        if name == "tick_mobile_arms":  # a tick that has begun has judged its reading
            stage = plain[2].records["stage"]
            stage[stage == Stage.BEGUN] = Stage.NONE
        compiled = [copied(value) for value in plain]
        with np.errstate(all="ignore"), kernels.plain_python():
            result = one.run(*plain)
        assert result == one.run(*compiled)
        for k, (mine, its) in enumerate(zip(plain, compiled, strict=True)):
            assert_same(mine, its, f"argument {k}")


def test_no_kernel_raises_to_a_power() -> None:
    """In Python ``x ** 2`` is a call of pow, which rounds otherwise than machine code's x * x."""
    for path in sorted((ROOT / "bhd_lerobot").rglob("*.py")):
        for one in ast.walk(ast.parse(text)) if "kernel(" in (text := path.read_text()) else ():
            if isinstance(one, ast.FunctionDef) and any("kernel(" in ast.unparse(by) for by in one.decorator_list):
                powers = [
                    each for each in ast.walk(one) if isinstance(each, ast.BinOp) and isinstance(each.op, ast.Pow)
                ]
                assert not powers, f"{path}: {one.name}"


@pytest.mark.law
def test_no_machine_code_outlives_a_change_of_what_a_kernel_calls_or_names(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = {name: one.code for name, one in KERNELS.items()}

    def changed() -> set[str]:
        return {name for name, code in compiled.items() if KERNELS[name].code != code}

    assert not changed()
    for module, name, value in (
        (setpoints, "_APPROACH", 0.6),
        (setpoints, "stoppable", kernels.kernel()(lambda room, *_: room)),
        (spring, "_ENTERED", (1,)),
        (spring, "clamp", kernels.kernel()(lambda value, low, high: value)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            assert changed() >= {"tick_arms", "tick_springs"}, name
            assert "read_odometry" not in changed()
    assert not changed()


@pytest.mark.law
def test_what_kernels_name_is_part_of_their_code() -> None:
    """Numbers are; modules are the interpreter's and numba's, whose versions are; C functions are called by name."""
    libraries = {"math", "np", "fence", "_copy", "_get_state", "_set_state", "_step"}
    kinds = (int, float, tuple, Kernel)
    importlib.import_module("bhd_lerobot.sim.frames")  # which imports all others
    modules = [module for name, module in sys.modules.items() if name.startswith("bhd_lerobot.")]
    for one in {value for module in modules for value in vars(module).values() if isinstance(value, Kernel)}:
        code, scope = one.function.__code__, one.function.__globals__
        assert one.function.__closure__ is None
        assert not any(isinstance(constant, CodeType) for constant in code.co_consts)
        named = {name: scope[name] for name in code.co_names if name in scope and name not in libraries}
        assert not {name: value for name, value in named.items() if not isinstance(value, kinds)}, one


@pytest.mark.parametrize("make", [base_rig, twist_rig, arm])
def test_what_was_loaded_compiles_nothing_in_a_loop_on_the_wall_clock(make: Callable[[], Any]) -> None:
    from numba.core.event import install_recorder

    rig = make()
    rig.cerebellum.load()
    with install_recorder("numba:compile") as record:
        rig.tick(50)
        rig.cerebellum.estop.press()
        rig.tick(50)
        rig.cerebellum.take_flags()
    assert record.buffer == []


def test_a_kernel_takes_no_other_types_than_it_was_compiled_for() -> None:
    base = BaseController(turtlebot3_burger().drive, 1, 200)
    good: list[Any] = [base.states, base.numbers, np.zeros((1, 2)), np.zeros((1, 3))]
    for position in range(4):
        for bad in (np.zeros((1, 3), np.float32), np.zeros(3)):
            with pytest.raises(TypeError, match="No matching definition"):
                read_odometry.run(*(bad if k == position else one for k, one in enumerate(good)))


def test_arrays_of_a_reading_are_not_replaced() -> None:
    reading = PlantReading(1, 2)
    reading.has_effort, reading.stamp_ns = True, np.zeros(1, np.int64)
    reading.position += 1.0
    assert reading.position.tolist() == [[1.0, 1.0]]
    with pytest.raises(
        TypeError, match=r"PlantReading.position is not to be replaced: write into it, out.position\[:\]"
    ):
        reading.position = np.zeros((1, 3))


def start(cache: Path, **environment: str) -> subprocess.Popen:
    program = (
        "import numpy as np\n"
        "from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger\n"
        "from bhd_lerobot.control.drive import BaseController, read_odometry\n"
        "base, odometry = BaseController(turtlebot3_burger().drive, 1, 200), np.zeros((1, 3))\n"
        "read_odometry.run(base.states, base.numbers, np.ones((1, 2)), odometry)\n"
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
