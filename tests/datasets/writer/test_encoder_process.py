"""Video encoders in a process of their own."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.datasets.format.video import CameraEncoder, VideoSettings, count_frames
from bhd_lerobot.datasets.writer import encoder_process
from bhd_lerobot.datasets.writer.encoder_process import EncoderProcess
from bhd_lerobot.errors import FrameError
from tests.waiting import until

SIZE = (48, 64)
SETTINGS = VideoSettings()


def images(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.full((*SIZE, 3), value, np.uint8) for value in rng.integers(0, 255, count)]


@pytest.fixture(scope="module")
def process() -> Iterator[EncoderProcess]:
    with closing(EncoderProcess()) as process:
        yield process


def test_the_same_file_as_in_this_process(process: EncoderProcess, tmp_path: Path) -> None:
    here = CameraEncoder(tmp_path / "here.mp4", 10, SIZE, SETTINGS)
    there = [process.encoder(tmp_path / f"there_{number}.mp4", 10, SIZE, SETTINGS) for number in range(2)]
    for image in images(40):
        here.add(image)
        for encoder in there:
            encoder.add(image)
    expected = here.finish()
    for encoder in there:
        np.testing.assert_array_equal(encoder.finish(), expected)
        assert encoder.path.read_bytes() == here.path.read_bytes()


def test_what_the_disk_refuses_is_raised_here(process: EncoderProcess, tmp_path: Path) -> None:
    encoder = process.encoder(tmp_path / "missing" / "a.mp4", 10, SIZE, SETTINGS)

    def encode() -> None:
        for image in images(200):
            encoder.add(image)
        encoder.finish()

    with pytest.raises(OSError, match=r"a\.mp4"):
        encode()
    encoder.cancel()
    other = process.encoder(tmp_path / "after.mp4", 10, SIZE, SETTINGS)
    other.add(images(1)[0])
    assert len(other.finish()) == 1


@pytest.mark.parametrize("wrong", [np.zeros((10, 10, 3), np.uint8), np.zeros((*SIZE, 3)), None])
def test_a_wrong_image_is_named(process: EncoderProcess, tmp_path: Path, wrong: object) -> None:
    encoder = process.encoder(tmp_path / "front.mp4", 10, SIZE, SETTINGS)
    with pytest.raises(FrameError, match=r"camera 'front' must be uint8 \(48, 64, 3\)"):
        encoder.add(wrong)  # type: ignore[arg-type]
    encoder.cancel()


def test_a_process_that_dies_is_noticed_and_nothing_waits_for_it_then_or_later(tmp_path: Path) -> None:
    with closing(EncoderProcess()) as process:
        encoder = process.encoder(tmp_path / "a.mp4", 10, SIZE, SETTINGS)
        encoder.add(images(1)[0])
        os.kill(process.pid, signal.SIGKILL)
        with pytest.raises(OSError, match="has ended"):
            until(lambda: [encoder.add(image) for image in images(10)] and False)
        later = process.encoder(tmp_path / "b.mp4", 10, SIZE, SETTINGS)
        for call in (encoder.finish, lambda: later.add(images(1)[0]), later.finish):
            with pytest.raises(OSError, match="has ended"):
                call()
        later.cancel()


def test_it_ends_with_the_process_that_started_it() -> None:
    before = threading.active_count()
    process = EncoderProcess()
    pid = process.pid
    process.close()
    process.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert threading.active_count() == before


def test_nobody_waits_for_an_encoder_that_does_not_keep_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images are dropped and counted; the one before stands in the place of each, and the video is complete."""
    monkeypatch.setattr(encoder_process, "_WAITING_BYTES", 10 << 20)
    size = (720, 1280)
    numbers = np.arange(60)
    with closing(EncoderProcess()) as process:
        encoder = process.encoder(tmp_path / "a.mp4", 10, size, SETTINGS)
        encoder.add(np.zeros((*size, 3), np.uint8))
        os.kill(process.pid, signal.SIGSTOP)  # as slow as can be
        for number in numbers[1:]:
            encoder.add(np.full((*size, 3), 4 * number, np.uint8))
        os.kill(process.pid, signal.SIGCONT)
        histograms = encoder.finish()
        assert 0 < process.images_per_s < 10_000
        after = process.encoder(tmp_path / "b.mp4", 10, size, SETTINGS)
        for _ in range(2):  # those before wait no more: there is room again
            after.add(np.zeros((*size, 3), np.uint8))
        assert len(after.finish()) == 2
        assert after.dropped == []
    assert encoder.frames == len(histograms) == count_frames(tmp_path / "a.mp4") == 60
    shown = histograms[:, 0].argmax(axis=1)
    expected = 4 * numbers
    assert 20 < len(encoder.dropped) <= 57  # three fit; the first is taken at once, or not yet
    for number in encoder.dropped:
        expected[number] = expected[number - 1]
    assert shown.tolist() == expected.tolist()


def test_a_cancelled_episode_is_not_encoded_to_its_end(tmp_path: Path) -> None:
    size = (720, 1280)
    with closing(EncoderProcess()) as process:
        encoder = process.encoder(tmp_path / "a.mp4", 10, size, SETTINGS)
        os.kill(process.pid, signal.SIGSTOP)
        for _ in range(60):
            encoder.add(np.zeros((*size, 3), np.uint8))
        thread = threading.Thread(target=encoder.cancel)
        thread.start()
        until(lambda: encoder.is_cancelled)
        os.kill(process.pid, signal.SIGCONT)
        thread.join()
        assert not encoder.path.exists() or count_frames(encoder.path) < 60
        other = process.encoder(tmp_path / "b.mp4", 10, size, SETTINGS)
        other.add(np.zeros((*size, 3), np.uint8))
        assert len(other.finish()) == 1
        assert encoder.dropped == []
