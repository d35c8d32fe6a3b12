"""Loops over simulations in plain scalar Python, and the machine code that numba makes of them once it is worth it.

To load numba and its code takes as long as some 5,000 ticks in Python: what is short
runs as it stands, as everything does with NUMBA_DISABLE_JIT=1. The results are the same bits.
"""

import hashlib
import math
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property, partial, update_wrapper
from pathlib import Path
from threading import RLock
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_values: float = 40_000  # that a loop handles in Python, until it is compiled
_LOCK = RLock()  # numba's cache folder is set for the whole process
# The code that may be compiled, as it is now: numba notices no change of what a kernel calls.
_CODE = b"".join(source.read_bytes() for source in sorted(Path(__file__).parent.rglob("*.py")))


RECORDS: dict[str, np.dtype[Any]] = {}
"""Structured types that signatures name."""


def record(name: str, fields: list[Any]) -> np.dtype[Any]:
    """Return a structured type for arrays of records, which signatures name; aligned, so that a field is one store."""
    RECORDS[name] = np.dtype(fields, align=True)
    return RECORDS[name]


class Kernel[**P, R]:
    """A function of numbers, arrays and records; other kernels may call it.

    Called as it is, it runs as plain Python. An array of records is a list of objects then, see `as_objects`.

    Args:
        function: the function.
        signature: the types of its arguments, in numba's words and those of `RECORDS`; empty for what only other
            kernels call.
        work: number of values that a record counts for.
    """

    def __init__(self, function: Callable[P, R], signature: str, work: int = 8) -> None:
        self.function, self.signature, self.work = function, signature, work
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:  # noqa: D102
        return self.function(*args, **kwargs)

    def of(self, name: str, signature: str, work: int = 8) -> "Kernel[P, R]":
        """Return the kernel of the same function for other types, such as None in the place of a record."""
        code, names = self.function.__code__, self.function.__globals__
        copy: Any = FunctionType(code, names, name, self.function.__defaults__, self.function.__closure__)
        copy.__qualname__ = name  # by which its machine code is found again
        copy.__doc__, copy.__module__ = self.function.__doc__, self.function.__module__
        return Kernel(copy, signature, work)

    @cached_property
    def compiled(self) -> Callable[..., R]:
        """The machine code, compiled at the first access, or loaded from the user's cache; it takes no other types."""
        import numba

        config: Any = numba.config
        if not self.signature:
            return numba.njit(error_model="numpy")(self.function)
        if config.DISABLE_JIT:
            return self._plain
        with _LOCK:
            return self._compile(numba, config)

    def _compile(self, numba: Any, config: Any) -> Callable[..., R]:
        folder = _folder()
        if folder is None or not any(folder.glob(f"*/*.{self.function.__name__}-*.nbi")):
            _announce()
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        names = {name: numba.from_dtype(dtype) for name, dtype in RECORDS.items()}
        signature = eval(self.signature, {}, {**vars(numba.types), **names})  # as numba does
        options: Any = {"error_model": "numpy", "nogil": True}
        try:
            return numba.njit(signature, cache=folder is not None, **options)(self.function)
        except Exception:  # a full disk, or a damaged file: compiled at every start
            return numba.njit(signature, **options)(self.function)
        finally:
            config.CACHE_DIR = before

    def _plain(self, *arguments: Any) -> Any:
        python: Callable[..., Any] = self.function
        return python(*map(as_objects, arguments))

    def handles(self, array: NDArray) -> int:
        """Return how many values a loop over an array handles; a record stands for many."""
        return array.size * self.work if array.dtype.names else array.size

    def bind(self, *bound: Any, is_spare: bool = False) -> Callable[..., R]:
        """Return this kernel with its first arguments, to be called with the others.

        It is compiled once it has handled `_values` values of its very first argument; a spare one, which may never be
        called, not before its first call.
        """
        self._check(0, bound)
        if (not _values and not is_spare) or (_values < math.inf and "compiled" in vars(self)):  # by another one
            return partial(self.compiled, *bound)
        left, is_checked = _values, False
        python: Callable[..., R] = self.function
        machine: Callable[..., R] | None = None
        plain: list[Any] = []

        def call(*arguments: Any) -> R:
            nonlocal left, is_checked, machine, plain
            if machine is not None:
                return machine(*arguments)
            left -= self.handles(bound[0] if bound else arguments[0])
            if left < 0:
                machine = partial(self.compiled, *bound)
                return machine(*arguments)
            if not is_checked:
                self._check(len(bound), arguments)
                is_checked, plain = True, [as_objects(value) for value in bound]
            return python(*plain, *arguments)

        return call

    @cached_property
    def arrays(self) -> list[tuple[np.dtype[Any], int, bool] | None]:
        """Type, dimensions and whether it must be C-contiguous of each argument; None for a number."""
        kinds = re.findall(r"(\w+)(\[[^\]]*\])?", self.signature.partition("(")[2])
        types = [RECORDS[name] if name in RECORDS else np.dtype(name) if shape else None for name, shape in kinds]
        shapes = [(shape.count(",") + 1, "::1" in shape) for _, shape in kinds]
        return [None if kind is None else (kind, *shape) for kind, shape in zip(types, shapes, strict=True)]

    def _check(self, first: int, arguments: tuple[Any, ...]) -> None:
        """Refuse what the machine code would refuse."""
        for at, argument in enumerate(arguments, first):
            kind = self.arrays[at]
            if kind and not (
                argument.dtype == kind[0] and argument.ndim == kind[1] and (argument.flags.c_contiguous or not kind[2])
            ):
                raise TypeError(
                    f"Argument {at} of {self.function.__name__} is an array of {argument.dtype} of shape "
                    f"{argument.shape}; its types are {self.signature}."
                )

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for inside of other kernels."""
        return self.compiled._numba_type_  # type: ignore[attr-defined]


class Fence:
    """Keeps the order of loads and stores: what is before it is seen, and done, before what is after it.

    For memory that processes share without a lock. Not between a store and a later load. On x86 there is nothing to do;
    other processors may let others see the counter that publishes a record before the record.

    Attributes:
        order: does it, outside of machine code.
    """

    def __init__(self, machine: str) -> None:
        self.order: Callable[[], Any] = _nothing if machine.lower() in ("x86_64", "amd64") else self._first

    def __call__(self) -> None:  # noqa: D102
        self.order()

    def _first(self) -> None:
        self.order = native_fence()
        self.order()

    @cached_property
    def compiled(self) -> Any:
        """The fence inside of machine code."""
        from numba import njit, types
        from numba.extending import intrinsic

        @intrinsic
        def fence(_: Any) -> Any:
            def generate(context: Any, builder: Any, *_: Any) -> Any:
                builder.fence("acq_rel")
                return context.get_dummy_value()

            return types.void(), generate

        return njit(lambda: fence())  # type: ignore[call-arg]  # noqa: PLW0108 (numba needs a function)

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for inside of kernels."""
        return self.compiled._numba_type_


def _nothing() -> None:
    return


def native_fence() -> Callable[[], Any]:
    """Return a fence as a function of machine code, whether numba compiles or not."""
    import ctypes

    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    module = binding.parse_assembly("define void @order() {\n  fence acq_rel\n  ret void\n}")
    engine = binding.create_mcjit_compiler(module, binding.Target.from_default_triple().create_target_machine())
    engine.finalize_object()
    function: Any = ctypes.PYFUNCTYPE(None)(engine.get_function_address("order"))
    function.engine = engine  # the code is freed with it
    return function


fence = Fence(platform.machine())


def as_objects(array: Any) -> Any:
    """Return an array of records as a list of objects with their fields, as plain Python reads them; others as it is.

    A number is a number, and an array a view.
    """
    if not (isinstance(array, np.ndarray) and array.dtype.names):
        return array
    kind = _object_type(array.dtype)
    return [kind(array[row : row + 1]) for row in range(len(array))]


@cache
def _object_type(dtype: np.dtype[Any]) -> Callable[[NDArray], Any]:
    fields = {name: kind for name, (kind, *_) in (dtype.fields or {}).items()}
    numbers = [name for name, kind in fields.items() if not kind.shape]

    def __init__(self: Any, row: NDArray) -> None:  # noqa: N807
        for name in numbers:
            setattr(self, f"_{name}", row[name])
        for name in fields.keys() - set(numbers):
            setattr(self, name, row[name][0])

    def number(name: str) -> property:
        def write(self: Any, value: Any) -> None:
            getattr(self, f"_{name}")[0] = value

        return property(lambda self: getattr(self, f"_{name}").item(), write)

    slots = [f"_{name}" if name in numbers else name for name in fields]
    body = {"__slots__": slots, "__init__": __init__, **{name: number(name) for name in numbers}}
    return type("Record", (), body)


def is_worth_compiling(one: Kernel[..., Any], handled: int) -> bool:
    """Return whether a loop that has handled so many values in Python should be compiled, or is already."""
    if "compiled" in vars(one) and _values < math.inf:
        return True
    if handled < _values:
        return False
    import numba

    config: Any = numba.config
    return not config.DISABLE_JIT


def compile_at_once() -> None:
    """Compile kernels from now on when they are bound, not in the middle of a run: for a loop on the wall clock."""
    global _values  # noqa: PLW0603
    _values = 0


@contextmanager
def never_compiled() -> Iterator[None]:
    """Bind kernels that stay Python: where a loop on the wall clock is running already."""
    global _values  # noqa: PLW0603
    before, _values = _values, math.inf
    try:
        yield
    finally:
        _values = before


def kernel[**P, R](signature: str = "", work: int = 8) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Make a kernel of a function, see `Kernel`."""
    return lambda function: Kernel(function, signature, work)


@cache
def _announce() -> None:
    print("Compiling the control loop for this processor: up to half a minute, once", file=sys.stderr)


@cache
def _folder() -> Path | None:
    """Return the folder of the compiled kernels of this code on this processor; None if it cannot be written."""
    from llvmlite import binding

    code = hashlib.sha256(f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}".encode())
    code.update(_CODE)
    code.update(os.environ.get("NUMBA_BOUNDSCHECK", "").encode())
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "bhd_lerobot" / "kernels" / code.hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):
        return None
    return folder


@kernel()
def clamp(value: float, low: float, high: float) -> float:
    """Return the value, or the bound that it is beyond; what is not a number stays so."""
    if value < low:
        return low
    return high if value > high else value


@kernel()
def largest_change(way: Any) -> Any:
    """Return the largest change of this tick from which changes can still fall to nothing at the end of a way.

    They may fall by 1 from tick to tick. Changes of 1, 2, … k add up to k (k + 1) / 2; what is left of the way is
    spread over these ticks.

    Args:
        way: what the changes have to add up to, not negative, in units of the largest difference of two changes; a
            number, or an array of any shape.
    """
    whole = np.floor(np.sqrt(way * 2.0 + 0.25) - 0.5)
    # whole + (way - whole (whole + 1) / 2) / (whole + 1)
    return way / (whole + 1.0) + whole * 0.5
