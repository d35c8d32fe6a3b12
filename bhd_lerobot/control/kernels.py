"""Loops over simulations that numba compiles: plain scalar Python, which runs as it stands with NUMBA_DISABLE_JIT=1."""

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any

import numpy as np


class Kernel[**P, R]:
    """A function of numbers and arrays; other kernels may call it.

    Called as it is, it runs as plain Python.

    Args:
        function: the function.
        signature: the types of its arguments, in numba's words; empty for what only other kernels call.
    """

    def __init__(self, function: Callable[P, R], signature: str) -> None:
        self.function, self.signature = function, signature
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:  # noqa: D102
        return self.function(*args, **kwargs)

    @cached_property
    def compiled(self) -> Callable[P, R]:
        """The machine code, compiled at the first access, or loaded from the user's cache; it takes no other types."""
        import numba

        config: Any = numba.config
        if config.DISABLE_JIT:
            return self.function
        if not self.signature:
            return numba.njit(error_model="numpy")(self.function)
        folder = _folder()
        if folder is None or not any(folder.glob(f"*/*.{self.function.__name__}-*.nbi")):
            print(f"Compiling {self.function.__name__} for this processor: some seconds, once", file=sys.stderr)
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            return numba.njit(self.signature, error_model="numpy", cache=folder is not None)(self.function)
        except Exception:  # a full disk, or a damaged file: compiled at every start
            return numba.njit(self.signature, error_model="numpy")(self.function)
        finally:
            config.CACHE_DIR = before

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for inside of other kernels."""
        return self.compiled._numba_type_  # type: ignore[attr-defined]


def kernel[**P, R](signature: str = "") -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Make a kernel of a function, see `Kernel`."""
    return lambda function: Kernel(function, signature)


@cache
def _folder() -> Path | None:
    """Return the folder of the compiled kernels of this code on this processor; None if it cannot be written."""
    from llvmlite import binding

    code = hashlib.sha256(f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}".encode())
    for source in sorted(Path(__file__).parent.rglob("*.py")):  # numba notices no change of what a kernel calls
        code.update(source.read_bytes())
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
