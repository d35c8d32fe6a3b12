"""What is true of the objects on a table, from what the task says: what perception learns to see."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.policies.perception.camera import Projection

_COLUMN = {name: OBJECT_FIELDS.index(name) for name in OBJECT_FIELDS}


def _columns(*names: str) -> slice:
    first = _COLUMN[names[0]]
    assert [_COLUMN[name] for name in names] == list(range(first, first + len(names)))
    return slice(first, first + len(names))


_POSITION, _SIZE, _COLOUR = (
    _columns("x", "y", "z"),
    _columns("length", "width", "height"),
    _columns("red", "green", "blue"),
)


@dataclass(frozen=True)
class Labels:
    """The objects of a batch of images; of places without an object only `present` means something.

    Attributes:
        present: whether there is one, shape (batch, places).
        position: of its centre in the base frame [m], shape (batch, places, 3).
        is_box: 1 for a box, 0 for a cup, shape (batch, places).
        colour: number of its colour in `COLOURS`, shape (batch, places).
        size: length, width and height [m], shape (batch, places, 3).
        yaw: rotation about the vertical axis [rad], shape (batch, places).
    """

    present: Tensor
    position: Tensor
    is_box: Tensor
    colour: Tensor
    size: Tensor
    yaw: Tensor

    @classmethod
    def of(cls, environment_state: Tensor) -> "Labels":
        """Return the labels in environment states of the task `pick`.

        Args:
            environment_state: shape (batch, 16 * places).
        """
        table = environment_state.reshape(len(environment_state), MAX_OBJECTS, len(OBJECT_FIELDS))
        palette = torch.tensor(list(COLOURS.values()), dtype=table.dtype, device=table.device)
        w, x, y, z = (table[..., _COLUMN[name]] for name in ("qw", "qx", "qy", "qz"))
        return cls(
            present=table[..., _COLUMN["present"]] > 0.5,
            position=table[..., _POSITION],
            is_box=table[..., _COLUMN["box"]],
            # Shades vary about the colour that has the name.
            colour=torch.cdist(table[..., _COLOUR].flatten(0, 1), palette).argmin(-1).reshape(table.shape[:2]),
            size=table[..., _SIZE],
            yaw=torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        )

    def zoomed(self, projection: Projection, about: NDArray[np.float32], factor: NDArray[np.float32]) -> "Labels":
        """Return what is true of images that were made larger: objects stand elsewhere, and have another size.

        Args:
            projection: the camera.
            about: the point of each image that stays where it is [px], shape (batch, 2).
            factor: by which each was made larger about it, shape (batch,).
        """
        places = self.position.detach().cpu().numpy().astype(np.float64)
        by = factor.astype(np.float64)[:, None]
        feet = np.concatenate([places[..., :2], np.zeros_like(places[..., :1])], axis=-1)
        seen, fixed = projection.pixels(feet), about.astype(np.float64)[:, None]
        moved = projection.on_plane(fixed + (seen - fixed) * by[..., None], 0.0)
        # What is twice as large in the image and twice as far away is four times as large.
        by = by * projection.depth(moved) / projection.depth(feet)
        # It is seen from the same side; the side that it is seen from has turned.
        before, after = (
            np.arctan2(one[..., 1] - projection.position[1], one[..., 0] - projection.position[0])
            for one in (feet, moved)
        )
        moved[..., 2] = places[..., 2] * by

        def tensor(values: NDArray[np.float64], like: Tensor) -> Tensor:
            return torch.as_tensor(values, dtype=like.dtype, device=like.device)

        return replace(
            self,
            position=tensor(moved, self.position),
            size=self.size * tensor(by, self.size)[..., None],
            yaw=self.yaw + tensor(after - before, self.yaw),
        )

    def at(self, places: Tensor) -> "Labels":
        """Return those of one place of each row for every entry of `places`, shape (batch, …)."""
        flat = places.flatten(1)

        def pick(values: Tensor) -> Tensor:
            index = flat.reshape(*flat.shape, *[1] * (values.ndim - 2)).expand(*flat.shape, *values.shape[2:])
            return values.gather(1, index).reshape(*places.shape, *values.shape[2:])

        return Labels(*(pick(getattr(self, name)) for name in self.__dataclass_fields__))
