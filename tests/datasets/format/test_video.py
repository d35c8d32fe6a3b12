"""Encoding blocks instead of dropping, and joining keeps every frame at its time."""

import os
import threading
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.datasets.format import statistics, video
from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings
from tests.waiting import until

SIZE = (32, 48)


def encode(path: Path, greys: list[int], settings: VideoSettings) -> Path:
    encoder = CameraEncoder(path, 10, SIZE, settings)
    for grey in greys:
        encoder.add(np.full((*SIZE, 3), grey, np.uint8))
    assert encoder.finish().shape == (len(greys), 3, 256)
    return path


@pytest.mark.parametrize("settings", [VideoSettings(queue_size=1), VideoSettings("libsvtav1", preset=12, queue_size=1)])
def test_no_encoder_gets_real_time_priority(tmp_path: Path, settings: VideoSettings) -> None:
    """SVT-AV1 takes `SCHED_FIFO` 99 where it may, for example as root."""
    encoder = CameraEncoder(tmp_path / "a.mp4", 10, SIZE, settings)
    for image in np.zeros((4, *SIZE, 3), np.uint8):
        encoder.add(image)  # more than may wait: the encoder is open
    assert {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")} == {os.SCHED_OTHER}
    encoder.finish()


def test_options_and_info_are_lerobots(tmp_path: Path) -> None:
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.video_utils import get_video_info

    for settings in (VideoSettings(), VideoSettings(vcodec="libsvtav1", preset=12, crf=30, fast_decode=1)):
        encoder = RGBEncoderConfig(**settings.recorded())
        ours = settings.codec_options()
        ours.pop("bf", None)  # without which streams could not be joined
        # With x264's macroblock tree, one in 40 encoders beside others makes something else of the same images.
        assert ours.pop("mbtree", "0") == "0"
        assert (settings.vcodec == "h264") == ("mbtree" in settings.codec_options())
        assert ours == encoder.get_codec_options(1, as_strings=True)
        path = encode(tmp_path / "a.mp4", [1, 2], settings)
        assert video.video_info(path, settings) == get_video_info(path, encoder)


def test_a_slow_encoder_makes_the_caller_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()
    real = statistics.image_histogram
    monkeypatch.setattr(statistics, "image_histogram", lambda image: (go.wait(), real(image))[1])
    encoder = CameraEncoder(tmp_path / "a.mp4", 10, SIZE, VideoSettings(queue_size=2))
    added: list[int] = []

    def produce() -> None:
        for i in range(20):
            encoder.add(np.full((*SIZE, 3), i, np.uint8))
            added.append(i)

    producer = threading.Thread(target=produce)
    producer.start()
    until(lambda: len(added) == 3)  # one image in the encoder, two in the queue
    go.set()
    producer.join()
    assert len(encoder.finish()) == 20
    assert video.count_frames(tmp_path / "a.mp4") == 20


def test_images_are_copied(tmp_path: Path) -> None:
    encoder = CameraEncoder(tmp_path / "a.mp4", 10, SIZE, VideoSettings())
    image = np.zeros((*SIZE, 3), np.uint8)
    for i in range(10):
        image[:] = i
        encoder.add(image)
    histograms = encoder.finish()
    assert histograms.argmax(axis=2)[:, 0].tolist() == list(range(10))
