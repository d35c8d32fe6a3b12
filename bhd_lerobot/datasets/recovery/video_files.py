"""The films of a recovered dataset: parts of old ones, or pictures that were not encoded yet."""

import contextlib
import itertools
import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from bhd_lerobot.datasets.format import video
from bhd_lerobot.datasets.format.video_splice import Span, splice
from bhd_lerobot.errors import UnsupportedDatasetError


def cut_out(
    path: Path, target: Path, spans: Sequence[Span], frames: tuple[int, str], fps: Fraction
) -> list[int] | None:
    """Write spans of a film into another one, which holds nothing else if each begins with a key frame.

    Args:
        path: the film.
        target: the new one.
        spans: what is needed of it.
        frames: how many of its frames can be read, and what is wrong with the next, if anything.
        fps: frames per second.

    Returns:
        Where each span begins in the new film; None if nothing was written, because the film can stay as it is.
    """
    count, problem = frames
    ends = list(itertools.accumulate(length for _, length in spans))
    begins = [0, *ends[:-1]]
    is_all = [start for start, _ in spans] == begins and ends[-1] == count
    if is_all and not problem:
        return None
    with contextlib.suppress(UnsupportedDatasetError):
        splice([(path, spans)], target, fps)
        return begins
    if not problem:
        return None
    splice([(path, [(0, max(start + length for start, length in spans))])], target, fps)
    return [start for start, _ in spans]


def encode(folder: Path, target: Path, length: int, fps: Fraction, feature: dict[str, Any]) -> None:
    """Write the pictures of an episode as a film, with the settings of the others."""
    from PIL import Image

    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder tells its life otherwise; 1 leaves errors
    with Image.open(folder / "frame-000000.png") as picture:
        width, height = picture.size  # a feature's shape may begin with the channels
    encoder = video.CameraEncoder(target, round(fps), (height, width), _settings(feature))
    try:
        for frame in range(length):
            with Image.open(folder / f"frame-{frame:06d}.png") as picture:
                encoder.add(np.asarray(picture.convert("RGB")))
        encoder.finish()
    except BaseException:
        encoder.cancel()
        raise


def _settings(feature: dict[str, Any]) -> video.VideoSettings:
    """Return the settings that the other films were encoded with, as far as this machine has their encoder."""
    told = feature.get("info") or {}
    encoder = {"av1": "libsvtav1", "hevc": "hevc", "h264": "h264"}.get(str(told.get("video.codec")), "h264")
    settings = video.VideoSettings(
        vcodec=encoder, g=told.get("video.g", 2), crf=told.get("video.crf", 23), preset=told.get("video.preset")
    )
    try:
        settings.check()
    except Exception:
        return video.VideoSettings()
    return settings
