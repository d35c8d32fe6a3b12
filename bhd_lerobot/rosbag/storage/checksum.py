"""Checksums that an export says of an episode, so that what comes back is what went out, or is refused."""

import json
from collections.abc import Mapping
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

SAID = ("task", "features", "metadata", "metadata_types", "recording", "video", "topics")
"""Texts of an `Episode` message that its checksum is over."""


def of_texts(fields: Mapping[str, Any]) -> int:
    """Return the checksum of what is said of an episode."""
    return crc32("\0".join(str(fields[name]) for name in SAID).encode())


def of_column(values: NDArray[Any]) -> int:
    """Return the checksum of a column: of its bytes, or of its texts."""
    if values.dtype == object:
        return crc32(json.dumps(values.tolist(), sort_keys=True, default=str).encode())
    return crc32(np.ascontiguousarray(values).tobytes())
