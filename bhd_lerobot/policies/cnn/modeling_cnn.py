"""`bhd_cnn`: from a base's last images and its odometry to a chunk of actions.

A camera shows a part of what is around a robot, and what is beside it has left the image when it matters. So the
network predicts of every image how far away things are in the directions that it shows, which a range finder taught it.
Odometry tells from where each image was taken: all of them together give the nearest thing in every direction around
the robot, as far as it has looked there. That and the present image are what actions depend on.
"""

from typing import Any

import torch
from torch import Tensor, nn

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.cnn.processor_cnn import OBS_ODOMETRY, OBS_RANGES
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy

_FIRST_KERNEL, _KERNEL = 5, 3  # [px]
_NEAR = 0.3  # [m] distance of a thing that is the input 1
_NEAREST = 0.1  # [m] nearer things count as this


class CnnPolicy(MlpPolicy):
    """The policy type ``bhd_cnn``."""

    config_class = CnnConfig
    name = "bhd_cnn"
    config: CnnConfig

    def __init__(self, config: CnnConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self._kept_keys = [*self._keys, OBS_ODOMETRY, config.image_key]
        width, height = config.image_size
        layers: list[nn.Module] = []
        channels = 3
        for number, following in enumerate(config.channels):
            kernel = _KERNEL if number else _FIRST_KERNEL
            layers += [nn.Conv2d(channels, following, kernel, 2, kernel // 2), nn.ReLU()]
            channels, width, height = following, (width + 1) // 2, (height + 1) // 2
        self.encoder = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(channels * width * height, config.image_dim), nn.ReLU()
        )
        self.ranges = nn.Linear(config.image_dim, len(config.range_columns))
        # Not part of the checkpoint: the configuration says it.
        angles = torch.tensor(config.range_angles)
        self.register_buffer("_directions", torch.stack([angles.cos(), angles.sin()], dim=-1), persistent=False)

    def features(self, batch: dict[str, Tensor]) -> Tensor:
        """Return what the perceptron sees, shape (batch, feature_size).

        Args:
            batch: what the preprocessor returns: `config.image_key`, shape (batch, n_obs_steps, 3, height, width),
                oldest first, 0 to 1; `observation.bhd_odometry`, shape (batch, n_obs_steps, 3); `observation.state` and
                `observation.environment_state` as in ``bhd_mlp``, of which no odometry, ranges or ignored numbers are
                read.
        """
        return self._look(batch)[0]

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a preprocessed batch, and its parts for the log.

        Args:
            batch: as in `features`; `observation.bhd_ranges`, shape (batch, n_obs_steps, ranges) [m]; `action` and
                `action_is_pad` as in ``bhd_mlp``.
            reduction: ``"mean"``, or ``"none"`` for one loss a row, shape (batch,).
        """
        features, log_range = self._look(batch)
        loss, outputs = self._compared(features, batch, reduction)
        true = self._history(batch, OBS_RANGES)[:, -1].clamp(self.config.range_minimum, self.config.range_maximum)
        error = (log_range - true.log()).abs().mean(-1)
        outputs["range_error"] = float(error.detach().mean())
        return loss + self.config.range_weight * (error if reduction == "none" else error.mean()), outputs

    def surroundings(self, ranges: Tensor, odometry: Tensor) -> Tensor:
        """Return how near things are in every direction around a robot.

        Args:
            ranges: in the directions `config.range_angles`, of the last images, shape (batch, images, ranges) [m].
            odometry: x [m], y [m] and yaw [rad] at each of them; the robot is where it was at the last one, shape
                (batch, images, 3).

        Returns:
            shape (batch, sectors), sector 0 beginning straight behind, counter-clockwise: 0.3 m divided by the distance
            to the nearest thing that was seen there; 0 where nothing was seen.
        """
        config = self.config
        place, yaw = odometry[..., :2] - odometry[:, -1:, :2], odometry[..., 2]
        # In the robot's frame at the time of each image, from the point that it turns about.
        points = ranges.unsqueeze(-1) * self._directions
        points = points + points.new_tensor([config.scanner_ahead, 0.0])
        points = _turned(points, yaw.unsqueeze(-1)) + place.unsqueeze(-2)  # in the odometry's directions
        x, y = _turned(points, -yaw[:, -1, None, None]).flatten(1, 2).unbind(-1)
        sector = ((torch.atan2(y, x) / (2 * torch.pi) + 0.5) * config.sectors).long() % config.sectors
        nearness = _NEAR / torch.hypot(x, y).clamp_min(_NEAREST)
        return nearness.new_zeros(len(x), config.sectors).scatter_reduce(1, sector, nearness, "amax")

    def _look(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return what the perceptron sees, and the logarithms of the ranges in the present image, (batch, ranges)."""
        images = self._images(batch)
        present = self.encoder(images[:, -1])
        log_range = self.ranges(present)
        # What it has in mind teaches it nothing about past images: each is the present one of another sample.
        with torch.no_grad():
            # One by one: all at once they do not fit into a processor's cache, and take more than twice as long.
            before = [self.ranges(self.encoder(image)) for image in images[:, :-1].unbind(1)]
            seen = torch.stack([*before, log_range], dim=1).exp()
            seen = seen.clamp(self.config.range_minimum, self.config.range_maximum)
            around = self.surroundings(seen, self._history(batch, OBS_ODOMETRY))
        return torch.cat([super().features(batch), around, present], dim=-1), log_range

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the images, from 0 to 1, shape (batch, n_obs_steps, 3, height, width)."""
        key, (width, height) = self.config.image_key, self.config.image_size
        images = batch.get(key)
        if images is None:
            raise ConfigError(
                f"{self.name} was trained with {key!r}, which is not in the batch. Set --robot.camera=true "
                f"--robot.camera_width={width} --robot.camera_height={height}."
            )
        images = images.unsqueeze(1) if images.ndim == 4 else images
        if tuple(images.shape[1:]) != (self.config.n_obs_steps, 3, height, width):
            raise ConfigError(
                f"{self.name} was trained with {self.config.n_obs_steps} images of {width} x {height} px; {key} has "
                f"the shape {tuple(images.shape[1:])} (images, channels, height, width)."
            )
        return images


def _turned(points: Tensor, angle: Tensor) -> Tensor:
    """Return points, shape (…, 2), turned counter-clockwise by angles [rad] of a shape that fits to theirs."""
    (x, y), cos, sin = points.unbind(-1), angle.cos(), angle.sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
