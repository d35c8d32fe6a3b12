"""Columns of a Parquet file as arrays."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def numbers(column: pa.ChunkedArray, frames: int) -> NDArray | None:
    """Return a column of numbers, of shape (frames, numbers); None if it holds something else."""
    array: Any = column.combine_chunks()
    while True:
        if isinstance(array.type, pa.BaseExtensionType):  # LeRobot's matrices
            array = array.storage
        elif pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
            array = array.flatten()
        else:
            break
    kind = array.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        return None
    values = np.asarray(array.to_numpy(zero_copy_only=False))
    if values.dtype == object:  # a column with gaps
        values = values.astype(np.float64)
    if frames == 0 or values.size % frames:
        return None
    return values.reshape(frames, -1)
