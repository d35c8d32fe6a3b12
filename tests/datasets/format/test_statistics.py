"""Statistics against numpy and against LeRobot's choice of pixels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.errors import FrameError


def test_values_that_are_not_finite() -> None:
    values = np.array([[1.0, np.nan], [np.inf, np.nan], [3.0, np.nan]])
    for name in ("observation.state", "action"):
        with pytest.raises(FrameError, match="frame 1"):
            statistics.column_stats({name: values[:, :1]})
    stats = statistics.column_stats({"control.age": values})["control.age"]
    assert stats["mean"].tolist() == [2.0, 0.0]
    assert stats["max"].tolist() == [3.0, 0.0]
    assert stats["count"].tolist() == [3]


@given(st.integers(1, 50_000))
def test_sampled_frames_are_lerobots(length: int) -> None:
    from lerobot.datasets.compute_stats import sample_indices

    assert statistics.sampled_frames(length).tolist() == sample_indices(length)


@pytest.mark.parametrize("size", [(48, 64), (40, 320), (400, 25)])
def test_images_against_numpy(size: tuple[int, int]) -> None:
    from lerobot.datasets.compute_stats import auto_downsample_height_width

    images = np.random.default_rng(0).integers(0, 256, (120, *size, 3)).astype(np.uint8)
    images[..., 1] //= 3
    stats = statistics.image_stats(np.stack([statistics.image_histogram(image) for image in images]))
    chosen = images[statistics.sampled_frames(120)]
    thinned = np.stack([auto_downsample_height_width(image.transpose(2, 0, 1)) for image in chosen]) / 255.0
    pixels = thinned.transpose(0, 2, 3, 1).reshape(-1, 3)
    for name, value in (
        ("min", pixels.min(0)),
        ("max", pixels.max(0)),
        ("mean", pixels.mean(0)),
        ("std", pixels.std(0)),
    ):
        np.testing.assert_allclose(stats[name].ravel(), value, atol=1e-9)
    for name, share in statistics.QUANTILES.items():
        wanted = np.quantile(pixels, share, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(stats[name].ravel(), wanted, atol=1e-9)
    assert stats["count"].tolist() == [len(chosen)]
    assert stats["mean"].shape == (3, 1, 1)
