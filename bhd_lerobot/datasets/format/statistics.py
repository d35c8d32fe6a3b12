"""Statistics of an episode, exact, and their aggregation over episodes.

The keys, shapes and meaning are LeRobot's. Quantiles are order statistics of the episode: the smallest value that at
least a share q of the frames does not exceed. LeRobot approximates the same value with a histogram of 5000 bins.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from bhd_lerobot.errors import FrameError

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)

_BLOCK = 32
_SLACK = 1e-3  # relative, of limits and deviations that are rounded

Stats = dict[str, np.ndarray]
"""Statistic name -> array: shape (d,) for columns, (3, 1, 1) for images, (1,) for the count."""


def column_stats(columns: Mapping[str, np.ndarray], *, finite: bool = True) -> dict[str, Stats]:
    """Return the statistics of every numeric column of an episode.

    Args:
        columns: key -> array of shape (T,) or (T, d) with T > 0; bool, int64, float32 or float64.
        finite: whether columns that a policy learns from must be finite; else the statistics are those of the finite
            values.

    Returns:
        Statistics as float64 arrays of shape (d,); `count` is the number of frames.
    """
    # Columns of one precision are stacked and sorted together: numpy sorts rows of floats with vector instructions,
    # and a call per column would cost more than the sorting.
    groups: dict[type, list[str]] = {}
    for key, values in columns.items():
        groups.setdefault(np.float32 if values.dtype in (np.float32, np.bool_) else np.float64, []).append(key)
    result: dict[str, Stats] = {}
    for precision, keys in groups.items():
        arrays = [columns[key].reshape(len(columns[key]), -1) for key in keys]
        widths = [array.shape[1] for array in arrays]
        rows: np.ndarray = np.empty((sum(widths), len(arrays[0])), dtype=precision)
        start = 0
        for array, width in zip(arrays, widths, strict=True):
            rows[start : start + width] = array.T
            start += width
        owners = [key if finite else "" for key, width in zip(keys, widths, strict=True) for _ in range(width)]
        stats = _row_stats(rows, owners)
        start = 0
        for key, width in zip(keys, widths, strict=True):
            result[key] = {name: values[start : start + width] for name, values in stats.items()}
            result[key]["count"] = np.array([len(columns[key])])
            start += width
    return {key: result[key] for key in columns}


def _row_stats(rows: np.ndarray, owners: Sequence[str]) -> Stats:
    """Return the statistics of every row of (D, T) values; `owners` names the column a row belongs to."""
    sorted_rows = np.sort(rows, axis=1)
    count = rows.shape[1]
    # NaN sorts last, so the two ends of a sorted row tell whether all of it is finite.
    broken = np.flatnonzero(~(np.isfinite(sorted_rows[:, 0]) & np.isfinite(sorted_rows[:, -1])))
    for row in broken:
        if owners[row].startswith(("observation", "action")):
            frame = int(np.flatnonzero(~np.isfinite(rows[row]))[0])
            position = int(row) - owners.index(owners[row])
            raise FrameError(
                f"{owners[row]!r} holds {rows[row, frame]} at position {position} of frame {frame}; values that a "
                "policy learns from must be finite."
            )
    mean, std = np.empty(len(rows)), np.empty(len(rows))
    with np.errstate(invalid="ignore", over="ignore"):
        # In blocks that fit the cache: in double precision the whole would be written to memory three times.
        for start in range(0, len(rows), _BLOCK):
            block = rows[start : start + _BLOCK].astype(np.float64)
            mean[start : start + _BLOCK] = block.mean(axis=1)
            block -= mean[start : start + _BLOCK, None]
            std[start : start + _BLOCK] = np.sqrt(np.einsum("ij,ij->i", block, block) / count)
    stats = {"min": sorted_rows[:, 0], "max": sorted_rows[:, -1], "mean": mean, "std": std}
    stats |= {name: sorted_rows[:, _rank(share, count)] for name, share in QUANTILES.items()}
    stats = {name: values.astype(np.float64) for name, values in stats.items()}
    for row in broken:
        finite = rows[row][np.isfinite(rows[row])]
        single = _row_stats((finite if finite.size else np.zeros(1, rows.dtype))[None], [""])
        for name, values in stats.items():
            values[row] = single[name][0]
    return stats


def _rank(share: float, count: int) -> int:
    """Return the index of a quantile among `count` sorted values; robust against 0.1 * 300 not being exactly 30."""
    return max(int(np.ceil(share * count - 1e-9)) - 1, 0)


def image_histogram(image: np.ndarray) -> np.ndarray:
    """Return how often each value occurs in a thinned image (H, W, 3) of bytes, shape (3, 256)."""
    height, width = image.shape[:2]
    step = 1
    if max(height, width) >= 300:
        # The same thinning as LeRobot's, so that both describe the same pixels.
        step = int(width / 150) if width > height else int(height / 150)
    thinned = image[::step, ::step]
    return np.stack([np.bincount(thinned[..., c].ravel(), minlength=256) for c in range(3)]).astype(np.uint32)


def sampled_frames(length: int) -> np.ndarray:
    """Return the frames of an episode whose pixels enter the statistics: LeRobot's choice, evenly spread."""
    count = max(min(100, length), min(int(length**0.75), 10_000))
    return np.round(np.linspace(0, length - 1, count)).astype(int)


def image_stats(histograms: np.ndarray) -> Stats:
    """Return the statistics of a camera over one episode, in [0, 1].

    Args:
        histograms: shape (T, 3, 256), one per frame.

    Returns:
        Arrays of shape (3, 1, 1); `count` is the number of frames that were sampled.
    """
    frames = sampled_frames(len(histograms))
    total = histograms[frames].sum(axis=0, dtype=np.int64)  # (3, 256)
    pixels = int(total[0].sum())
    values = np.arange(256, dtype=np.float64)
    mean = total @ values / pixels
    present = total > 0
    cumulated = total.cumsum(axis=1)
    stats = {
        "min": present.argmax(axis=1),
        "max": 255 - present[:, ::-1].argmax(axis=1),
        "mean": mean,
        "std": np.sqrt((total * (values - mean[:, None]) ** 2).sum(axis=1) / pixels),
    }
    stats |= {name: (cumulated > _rank(share, pixels)).argmax(axis=1) for name, share in QUANTILES.items()}
    result = {name: (np.asarray(value, np.float64) / 255.0).reshape(3, 1, 1) for name, value in stats.items()}
    return {**result, "count": np.array([len(frames)])}


def are_possible(stats: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which standard deviations any values between these limits can have, shape (d,).

    Of n values from a to b that of a frame at each end is at least (b - a) / sqrt(2 n), and none is above (b - a) / 2.
    LeRobot takes it as the mean of the squares minus the square of the mean, in single precision: far from zero nothing
    of it is left, or much more than that. Numbers that do not change, or are not finite, are not judged.

    Args:
        stats: `min`, `max`, `std`, each of shape (d,), and `count`, of shape (1,).
    """
    with np.errstate(invalid="ignore"):
        span = (stats["max"] - stats["min"]).astype(np.float64)
        is_above = stats["std"] > span / 2 * (1 + _SLACK)
        is_below = stats["std"] < span / np.sqrt(2 * stats["count"]) * (1 - _SLACK)
    return ~((is_above | is_below) & (span > 0))


def aggregate(stacked: Mapping[str, np.ndarray]) -> Stats:
    """Return the statistics of several episodes together.

    Minimum, maximum, mean and standard deviation are exact. Quantiles are the average of the episodes' quantiles
    weighted by their frames, which is LeRobot's convention and only an approximation of the quantile of all frames.

    Args:
        stacked: statistic -> values of all episodes, shape (E, ...); counts have the shape (E, 1). Quantiles may be
            absent: datasets of older versions have none.
    """
    counts = stacked["count"].astype(np.float64)
    weights = counts.reshape(-1, *[1] * (stacked["mean"].ndim - 1)) / counts.sum()
    with np.errstate(invalid="ignore", over="ignore"):  # other programs store what is not finite, too
        mean = (weights * stacked["mean"]).sum(axis=0)
        variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": stacked["count"].sum(axis=0),
        **{name: (weights * stacked[name]).sum(axis=0) for name in QUANTILES if name in stacked},
    }
