"""Functions over numbers, arrays and records in plain scalar Python, which numba compiles when they are first run.

With NUMBA_DISABLE_JIT=1 they run as they stand, for a debugger. The results are the same bits.
"""

import hashlib
import os
import platform
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

_is_plain = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
_LOCK = RLock()  # numba's cache folder is set for the whole process
_OWN_CODE = Path(__file__).read_bytes()

RECORDS: dict[str, np.dtype[Any]] = {}
"""Structured types that signatures name."""


def record(name: str, fields: list[Any]) -> np.dtype[Any]:
    """Return a structured type for arrays of records, which signatures name; aligned, so that a field is one store."""
    RECORDS[name] = np.dtype(fields, align=True)
    return RECORDS[name]


TUPLES: dict[str, type[tuple[Any, ...]]] = {}
"""Named tuples that signatures name."""


def group[T: type[tuple[Any, ...]]](kind: T) -> T:
    """Let signatures name a named tuple of arguments, with the types of its fields in brackets."""
    TUPLES[kind.__name__] = kind
    return kind


class Kernel[**P, R]:
    """A function of numbers, arrays, records and groups of them; other kernels may call it.

    Called as it is, it is plain Python. An array of records is a list of objects then, see `as_objects`.

    Args:
        function: the function.
        signature: the types of its arguments, in numba's words and those of `RECORDS` and `TUPLES`; empty for what only
            other kernels call.
    """

    def __init__(self, function: Callable[P, R], signature: str) -> None:
        self.function, self.signature = function, signature
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:  # noqa: D102
        return self.function(*args, **kwargs)

    def of(self, name: str, signature: str) -> "Kernel[P, R]":
        """Return the kernel of the same function for other types, such as None in the place of a record."""
        code, names = self.function.__code__, self.function.__globals__
        copy: Any = FunctionType(code, names, name, self.function.__defaults__, self.function.__closure__)
        copy.__qualname__ = name  # by which its machine code is found again
        copy.__doc__, copy.__module__ = self.function.__doc__, self.function.__module__
        return Kernel(copy, signature)

    def run(self, *arguments: Any) -> R:
        """Run the machine code, or plain Python where nothing is to be compiled."""
        if _is_plain or not self.signature:
            python: Callable[..., R] = self.function
            return python(*map(as_objects, arguments))
        return self.compiled(*arguments)

    @cached_property
    def unchecked(self) -> Callable[..., R]:
        """The machine code without the check of its arguments' types, which takes several times as long as the call.

        For a caller that has called `compiled` with these arguments, or with others of the same types.
        """
        one: Any = self.compiled
        entry: Callable[..., R] = one.overloads[one.signatures[0]].entry_point
        return entry

    def load(self) -> None:
        """Compile it now, or load it, and not when it is first run: before a loop on the wall clock begins."""
        if not _is_plain:
            _ = self.compiled

    @cached_property
    def compiled(self) -> Callable[..., R]:
        """The machine code, compiled at the first access, or loaded from the user's cache; it takes no other types."""
        import numba

        config: Any = numba.config
        if not self.signature:  # Python cannot call it, which saves a seventh of the time
            options: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
            return numba.njit(error_model="numpy", **options)(self.function)
        with _LOCK:
            return self._compile(numba, config)

    @property
    def code(self) -> str:
        """What is compiled: its bytecode and that of the kernels that it calls, with the constants that they name."""
        kernels: list[Kernel[..., Any]] = [self]
        parts = []
        for one in kernels:  # which grows
            code, scope = one.function.__code__, one.function.__globals__
            named = {name: scope[name] for name in code.co_names if name in scope}
            constants = {name: value for name, value in named.items() if isinstance(value, int | float | tuple)}
            parts.append(repr((code.co_code, code.co_consts, code.co_names, one.function.__defaults__, constants)))
            kernels += [value for value in named.values() if isinstance(value, Kernel) and value not in kernels]
        return "\n".join(parts)

    def _compile(self, numba: Any, config: Any) -> Callable[..., R]:
        folder = _folder(self.code)
        if folder is None or not any(folder.glob(f"*/*.{self.function.__name__}-*.nbi")):
            _announce()
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        names: dict[str, Any] = {name: numba.from_dtype(dtype) for name, dtype in RECORDS.items()}
        names |= {name: partial(_tuple_type, kind) for name, kind in TUPLES.items()}
        signature = eval(self.signature, {}, {**vars(numba.types), **names})  # as numba does
        options: Any = {"error_model": "numpy", "nogil": True}
        try:
            return numba.njit(signature, cache=folder is not None, **options)(self.function)
        except Exception:  # a full disk, or a damaged file: compiled at every start
            return numba.njit(signature, **options)(self.function)
        finally:
            config.CACHE_DIR = before

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for inside of other kernels."""
        return self.compiled._numba_type_  # type: ignore[attr-defined]


def _tuple_type(kind: type[tuple[Any, ...]], *fields: Any) -> Any:
    from numba import types

    return types.BaseTuple.from_types(fields, kind)


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

    Of a named tuple each field. A number is a number, and an array a view.
    """
    if type(array) in TUPLES.values():
        return type(array)(*map(as_objects, array))
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


def is_plain() -> bool:
    """Return whether kernels run as plain Python."""
    return _is_plain


@contextmanager
def plain_python() -> Iterator[None]:
    """Run kernels as plain Python inside of this, as with NUMBA_DISABLE_JIT=1; others may take their place then."""
    global _is_plain  # noqa: PLW0603
    before, _is_plain = _is_plain, True
    try:
        yield
    finally:
        _is_plain = before


def kernel[**P, R](signature: str = "") -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Make a kernel of a function, see `Kernel`."""
    return lambda function: Kernel(function, signature)


@cache
def _announce() -> None:
    print("Compiling the control loop for this processor: up to half a minute, once", file=sys.stderr)


def _folder(kernel_code: str) -> Path | None:
    """Return the folder of the machine code of a kernel on this processor; None if it cannot be written.

    It is named by all that is compiled: numba looks at the file of the outermost kernel alone.
    """
    from llvmlite import binding

    code = hashlib.sha256(f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}".encode())
    code.update(_OWN_CODE)
    code.update(kernel_code.encode())
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
