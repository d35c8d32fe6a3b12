"""Columns of an episode as bytes that a browser turns into typed arrays without parsing numbers.

The layout is: the four bytes ``BHDV``; the length of the header, uint32 little endian; the header, JSON in UTF-8,
padded with spaces; the arrays, little endian, row after row. The body, and every array in it, begins at a multiple of 8
bytes.
"""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"BHDV"
_ALIGN = 8
_TYPES = ("float32", "float64", "uint8", "int32")


def pack(header: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> bytes:
    """Return a header and arrays as bytes.

    Args:
        header: plain values, without a key ``arrays``. Numbers that are not finite become null.
        arrays: Booleans become uint8, and whole numbers int32, or float64 if they are too large for that.
    """
    described: dict[str, Any] = {}
    body: list[bytes] = []
    at = 0
    for name, array in arrays.items():
        values = np.ascontiguousarray(_portable(array))
        described[name] = {"dtype": values.dtype.name, "shape": list(values.shape), "offset": at}
        content = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
        content += bytes(-len(content) % _ALIGN)
        body.append(content)
        at += len(content)
    text = to_json({**header, "arrays": described}).encode()
    text += b" " * (-(len(MAGIC) + 4 + len(text)) % _ALIGN)
    return b"".join([MAGIC, struct.pack("<I", len(text)), text, *body])


def unpack(content: bytes) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Return header and arrays of what `pack` made, or raise a ValueError; as the page does, for tests."""
    start = len(MAGIC) + 4
    if content[: len(MAGIC)] != MAGIC:
        raise ValueError(f"The content begins with {content[:4]!r}, not with {MAGIC!r}.")
    (length,) = struct.unpack("<I", content[len(MAGIC) : start])
    header = json.loads(content[start : start + length])
    arrays = {}
    for name, about in header.pop("arrays").items():
        kind, count = np.dtype(about["dtype"]).newbyteorder("<"), int(np.prod(about["shape"], dtype=np.int64))
        arrays[name] = np.frombuffer(content, kind, count, start + length + about["offset"]).reshape(about["shape"])
    return header, arrays


def to_json(value: Any) -> str:
    """Return plain values as JSON that every reader takes: what is not finite is null."""
    return json.dumps(finite(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def finite(value: Any) -> Any:
    """Return plain values for JSON: what is not finite is None."""
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value


def _portable(array: NDArray) -> NDArray:
    if array.dtype.name in _TYPES:
        return array
    if array.dtype == np.bool_:
        return array.astype(np.uint8)
    if np.issubdtype(array.dtype, np.integer):
        small = np.iinfo(np.int32)
        fits = array.size == 0 or (array.min() >= small.min and array.max() <= small.max)
        return array.astype(np.int32 if fits else np.float64)
    return array.astype(np.float32 if array.dtype == np.float16 else np.float64)
