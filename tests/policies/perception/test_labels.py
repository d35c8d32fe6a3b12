"""What is true of images that were made larger or smaller."""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from bhd_lerobot.bodies.tabletop import SCENE_CAMERA
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.labels import Labels

CAMERA = Projection(SCENE_CAMERA, 320, 240)
SIDES = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def table(rng: np.random.Generator, count: int) -> Labels:
    """Return tables with one box each, where the task `pick` may put it."""
    size = rng.uniform((0.03, 0.03, 0.03), (0.13, 0.076, 0.15), (count, 1, 3))
    position = rng.uniform((0.35, -0.30, 0.0), (0.65, 0.30, 0.0), (count, 1, 3))
    position[..., 2] = size[..., 2] / 2
    return Labels(
        present=torch.ones(count, 1, dtype=torch.bool),
        position=torch.from_numpy(position),
        is_box=torch.ones(count, 1),
        colour=torch.zeros(count, 1, dtype=torch.long),
        size=torch.from_numpy(size),
        yaw=torch.from_numpy(rng.uniform(-1.5, 1.5, (count, 1))),
    )


def corners(labels: Labels) -> NDArray[np.float64]:
    """Return where the image shows the corners of every box [px], shape (count, 8, 2)."""
    size, yaw = labels.size.numpy()[:, 0], labels.yaw.numpy()[:, 0]
    x, y, z = np.moveaxis(SIDES * size[:, None], -1, 0)
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    points = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)
    return CAMERA.pixels(labels.position.numpy() + points)


def test_corners_go_where_the_larger_image_shows_them() -> None:
    rng = np.random.default_rng(0)
    count = 500
    labels = table(rng, count)
    about = rng.uniform((60, 40), (260, 200), (count, 2)).astype(np.float32)
    factor = np.exp(rng.uniform(-0.3, 0.3, count)).astype(np.float32)

    zoomed = labels.zoomed(CAMERA, about, factor)

    before, after = corners(labels), corners(zoomed)
    shown = about[:, None] + (before - about[:, None]) * factor[:, None, None]
    apart = np.linalg.norm(after - shown, axis=-1)
    # Exact where it stands on the table; what is above that is seen from a little higher or lower.
    assert np.median(apart) < 0.5
    assert np.quantile(apart, 0.95) < 2.0
    assert np.median(np.linalg.norm(after - before, axis=-1)) > 5.0
    assert np.abs((after - shown).mean((0, 1))).max() < 0.1
    standing = zoomed.position[..., 2] - zoomed.size[..., 2] / 2
    torch.testing.assert_close(standing, torch.zeros_like(standing), atol=1e-6, rtol=0)
    assert torch.equal(zoomed.present, labels.present)
    assert torch.equal(zoomed.colour, labels.colour)
