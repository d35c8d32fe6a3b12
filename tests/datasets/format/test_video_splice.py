"""Cut and joined videos show the same images, whatever encoder made them and in whatever order they store frames."""

import os
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from bhd_lerobot.datasets.format.video_splice import splice
from bhd_lerobot.errors import DatasetCorruptError, UnsupportedDatasetError
from tests.datasets.edit_support import images

os.environ.setdefault("SVT_LOG", "1")
LENGTHS = (7, 12, 5, 9)
STARTS = (0, 7, 19, 24)
ENCODERS = [
    ("libx264", {"g": "2", "bf": "0"}),
    ("libx264", {"g": "30", "bf": "3"}),  # frames out of order
    ("libx265", {"g": "30", "x265-params": "log-level=none:bframes=3"}),
    ("libsvtav1", {"g": "2"}),  # LeRobot's own
    ("libsvtav1", {"g": "240"}),
]


def encode(path: Path, frames: int, seed: int, codec: str, options: dict[str, str]) -> Path:
    image = np.random.default_rng(seed).integers(20, 150, (48, 64, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, 10, options=options)
        stream.width, stream.height, stream.pix_fmt, stream.time_base = 64, 48, "yuv420p", Fraction(1, 10)
        for index in range(frames):
            frame = av.VideoFrame.from_ndarray(np.roll(image, 3 * index, axis=1), format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(("codec", "options"), ENCODERS)
def test_every_image_stays(tmp_path: Path, codec: str, options: dict[str, str]) -> None:
    from lerobot.datasets.video_utils import concatenate_video_files

    parts = [encode(tmp_path / f"{i}.mp4", n, i, codec, options) for i, n in enumerate(LENGTHS)]
    shown = [images(part) for part in parts]
    concatenate_video_files(parts, tmp_path / "all.mp4")  # as LeRobot records
    spans = [(STARTS[2], LENGTHS[2]), (STARTS[0], LENGTHS[0])]
    splice([(tmp_path / "all.mp4", spans), (parts[3], [(0, LENGTHS[3])])], tmp_path / "new.mp4", 10)
    assert images(tmp_path / "new.mp4") == shown[2] + shown[0] + shown[3]
    with av.open(str(tmp_path / "new.mp4")) as video:
        times = [float(frame.pts * frame.time_base) for frame in video.decode(video=0)]  # type: ignore[operator]
    assert times == pytest.approx(np.arange(len(times)) / 10)
    # And what was spliced can be spliced again.
    splice([(tmp_path / "new.mp4", [(LENGTHS[2], LENGTHS[0])])], tmp_path / "again.mp4", 10)
    assert images(tmp_path / "again.mp4") == shown[0]


def test_an_episode_without_a_key_frame_is_refused(tmp_path: Path) -> None:
    path = encode(tmp_path / "f.mp4", 20, 0, *ENCODERS[1])
    with pytest.raises(UnsupportedDatasetError, match=r"frame 5.*is no key frame.*lerobot-edit-dataset"):
        splice([(path, [(5, 5)])], tmp_path / "new.mp4", 10)


def test_damaged_videos_are_named(tmp_path: Path) -> None:
    path = encode(tmp_path / "f.mp4", 10, 0, *ENCODERS[0])
    with pytest.raises(DatasetCorruptError, match=r"f\.mp4 has 4 of the 6 frames from 6 on"):
        splice([(path, [(6, 6)])], tmp_path / "new.mp4", 10)
    (tmp_path / "none.mp4").write_bytes(b"no video")
    with pytest.raises(DatasetCorruptError, match=r"none\.mp4 is not a readable video"):
        splice([(tmp_path / "none.mp4", [(0, 1)])], tmp_path / "new.mp4", 10)
