"""What was measured several times, in a few numbers."""

import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Return the median of some measurements, the least and the largest of them, and how many there were."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values), "turns": len(values)}


def ratios(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    """Return ours over theirs, turn by turn: a noisy neighbour disturbs all of a turn."""
    return [mine / other for mine, other in zip(ours, theirs, strict=True)]


def write(path: Path | None, results: Any) -> None:
    """Write results as JSON, if a file was named."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
