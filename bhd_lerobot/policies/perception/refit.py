"""Where a camera stands that was moved: from objects whose places are known, and where they are seen."""

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bhd_lerobot.bodies.tabletop import CameraView
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.labels import Labels

if TYPE_CHECKING:
    from bhd_lerobot.policies.perception.modeling_perception import Detections

_SCALE = 2.0  # [px] residuals that are larger count less than their square: what was taken for another object
_MOVE = 0.1  # [m] and [rad] by which a camera may easily be moved; it counts as much as a residual of 1 px
_COLOUR = 0.2  # of the image's width: as much counts that an object has another colour


def matched(found: "list[Detections]", labels: Labels, camera: Projection) -> tuple[NDArray[np.float64], ...]:
    """Return where objects are, shape (k, 3) [m], and where they were seen, shape (k, 2) [px].

    What was found belongs to the object that is nearest in the image and likeliest in colour.

    `camera`: where the camera was taken to be when that was found.
    """
    places, pixels = [], []
    for row, seen in enumerate(found):
        present = labels.present[row]
        true, colours = labels.position[row][present].cpu().double().numpy(), labels.colour[row][present].cpu().numpy()
        if not len(true) or not len(seen.presence):
            continue
        at = camera.pixels(seen.position.cpu().double().numpy())
        apart = np.linalg.norm(at[:, None] - camera.pixels(true)[None], axis=-1)
        apart += _COLOUR * camera.width * (1 - seen.colour.cpu().numpy()[:, colours])
        places.append(true[apart.argmin(axis=1)])
        pixels.append(at)
    if not places:
        return np.zeros((0, 3)), np.zeros((0, 2))
    return np.concatenate(places), np.concatenate(pixels)


def fit_view(
    view: CameraView, size: tuple[int, int], places: NDArray[np.float64], pixels: NDArray[np.float64]
) -> CameraView:
    """Return the view that shows points where they were seen, by robust least squares; six numbers are found.

    Args:
        view: from which it was moved; the field of view, and how far the target is, stay.
        size: of the images [px].
        places: of the points, shape (k, 3) [m].
        pixels: where they were seen, shape (k, 2) [px].
    """
    ahead = np.subtract(view.target, view.position)
    distance = float(np.linalg.norm(ahead))
    start = [*view.position, math.atan2(ahead[1], ahead[0]), math.asin(ahead[2] / distance), view.roll]

    def made(values: NDArray[np.float64]) -> CameraView:
        *position, azimuth, elevation, roll = values.tolist()
        across = distance * math.cos(elevation)
        offset = (across * math.cos(azimuth), across * math.sin(azimuth), distance * math.sin(elevation))
        target = tuple(np.add(position, offset).tolist())
        return CameraView(tuple(position), target, view.fovy, roll)

    def residuals(values: NDArray[np.float64]) -> NDArray[np.float64]:
        astray = Projection(made(values), *size).pixels(places) - pixels
        return np.concatenate([astray.ravel(), (values - start) / _MOVE])

    return made(least_squares(residuals, start, loss="soft_l1", f_scale=_SCALE, x_scale="jac").x)
