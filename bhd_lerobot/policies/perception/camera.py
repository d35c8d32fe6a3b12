"""Where a fixed camera sees a point of the base frame, and which point of a plane a pixel shows."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.tabletop import CameraView

Region = tuple[int, int, int, int]
"""Part of an image: first column, first row, and those behind the last [px]."""


class Projection:
    """A pinhole camera and the size of its images [px].

    Attributes:
        position: of its centre in the base frame [m].
    """

    def __init__(self, view: CameraView, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._focal = height / 2 / math.tan(math.radians(view.fovy) / 2)
        self.position = np.asarray(view.position, np.float64)
        ahead = np.subtract(view.target, view.position)
        self._ahead = ahead / np.linalg.norm(ahead)
        right = np.array([ahead[1], -ahead[0], 0.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, self._ahead)
        self._right = math.cos(view.roll) * right - math.sin(view.roll) * up
        self._up = math.sin(view.roll) * right + math.cos(view.roll) * up

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return column and row [px] of points in front of the camera, shape (…, 2).

        Args:
            points: in the base frame [m], shape (…, 3).
        """
        ray = points - self.position
        depth = self.depth(points)
        column = self.width / 2 + self._focal * (ray @ self._right) / depth
        return np.stack([column, self.height / 2 - self._focal * (ray @ self._up) / depth], axis=-1)

    def depth(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far points are from the camera along its line of sight [m], shape (…,).

        Args:
            points: in the base frame [m], shape (…, 3).
        """
        return (points - self.position) @ self._ahead

    def on_plane(self, pixels: NDArray[np.float64], z: float) -> NDArray[np.float64]:
        """Return the points of a horizontal plane that pixels show, in the base frame [m], shape (…, 3).

        Args:
            pixels: columns and rows [px], shape (…, 2).
            z: height of the plane [m].
        """
        column = (pixels[..., :1] - self.width / 2) / self._focal
        row = (self.height / 2 - pixels[..., 1:]) / self._focal
        ray = column * self._right + row * self._up + self._ahead
        return self.position + ray * ((z - self.position[2]) / ray[..., 2:])

    def region(self, low: tuple[float, ...], high: tuple[float, ...], margin: float, multiple: int) -> Region:
        """Return the part of the image in which a box of the base frame is seen.

        The box is from `low` to `high`, x, y, z [m]; width and height of the part are a multiple of `multiple` [px].
        """
        corners = self.pixels(np.array(list(itertools.product(*zip(low, high, strict=True)))))
        margin *= self.width
        first = np.maximum(np.floor(corners.min(axis=0) - margin), 0).astype(int)
        last = np.minimum(np.ceil(corners.max(axis=0) + margin), (self.width, self.height)).astype(int)
        size = (last - first) // multiple * multiple
        if (size <= 0).any():
            raise ValueError(f"the camera does not see {low} to {high}")
        left, top = first.tolist()
        width, height = size.tolist()
        return left, top, left + width, top + height
