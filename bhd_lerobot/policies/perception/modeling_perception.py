"""`bhd_perception`: a small convolutional network that states what stands where on the table, and how sure it is.

On a grid of cells of the image, each cell says whether an object's centre is near, and where that centre is in the base
frame: the point of the table that the cell shows where the camera was not moved, plus what the network adds. What it
adds may depend on the whole image, in which edges of the table and the arm's foot show how the camera was moved.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor, nn
from torch.nn import functional

from bhd_lerobot.bodies.tabletop import COLOURS
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.perception.camera import Region
from bhd_lerobot.policies.perception.configuration_perception import STRIDE, PerceptionConfig
from bhd_lerobot.policies.perception.labels import Labels
from bhd_lerobot.policies.perception.refit import fit_view, matched

# What has a length is of a UR5's objects; of others times `config.scale`.
_PLANE = 0.04  # [m] height of the plane that cells are projected to: about the middle of objects
_SPREAD = 1.5  # [cells] standard deviation of the bump in the map of presence that an object's centre is to leave
_NEAR = 0.3  # cells in which that bump is at least this high say where the object is
_SHIFT, _ERROR, _SIZE = 0.05, 0.01, 0.07  # [m] what 1 means in the network's answers
_LOG_ERROR = (-4.0, 3.0)
_DISTINCT = 0.025  # [m] what is found nearer to something surer is that
_TAIL = 0.9  # share of errors that is to lie within the radius that the calibration is done for
_RADIUS = 3.889720169867429  # in units of the scale, within which a radius of density exp(-r) r lies with `_TAIL`
_ZOOMED = 0.6  # share of the images that are learned from larger or smaller
_SHADES = 24  # numbers that tell the colour of a cell
_FITS = 6  # rounds: what is seen depends a little on where the camera is taken to be
_LEAST_SEEN = 12  # objects; each gives two numbers, and six are to be found from what may in part be wrong
_OUTPUTS = {
    "presence": 1,
    "shift": 3,
    "log_error": 1,
    "is_box": 1,
    "colour": len(COLOURS),
    "size": 3,
    "yaw": 4,
}


@dataclass(frozen=True)
class Detections:
    """What was found in one image, the surest first; k objects.

    Attributes:
        presence: probability that there is an object, shape (k,).
        position: of its centre in the base frame [m], shape (k, 3).
        scale: of the error in x and y: its radius r is expected with the density exp(-r / scale) r / scale² [m], shape
            (k,).
        is_box: probability that it is a box, shape (k,).
        colour: probability of each of `COLOURS`, shape (k, colours).
        size: length, width and height [m], shape (k, 3).
        yaw: of a box, from -pi/2 to pi/2 [rad], shape (k,).
    """

    presence: Tensor
    position: Tensor
    scale: Tensor
    is_box: Tensor
    colour: Tensor
    size: Tensor
    yaw: Tensor


class PerceptionPolicy(PreTrainedPolicy):
    """The policy type ``bhd_perception``. It gives no actions; brains ask it for `detect`.

    In evaluation mode, `forward` also calibrates: the stated errors are scaled so that of the errors on what was not
    learned from, the wanted share lies within the stated radius (A. Angelopoulos and S. Bates, "A gentle introduction
    to conformal prediction", 2021).
    """

    config_class = PerceptionConfig
    name = "bhd_perception"
    config: PerceptionConfig
    answer_size = sum(_OUTPUTS.values())
    """Numbers that it says of every cell."""
    factor: Tensor
    _plane: Tensor

    def __init__(self, config: PerceptionConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self._shift, self._error, self._size = (config.scale * unit for unit in (_SHIFT, _ERROR, _SIZE))
        self.network = _Network(config)
        self._aim()
        # What stated errors are multiplied by; not a number until errors on held-out images are known.
        self.register_buffer("factor", torch.tensor(math.nan))
        self._ratios: list[Tensor] = []

    def _aim(self) -> None:
        """Find out what follows from where the camera stands: the region, its cells, and what they show."""
        config, device = self.config, next(self.network.parameters()).device
        left, top, right, bottom = region = config.region
        self.network.aim(region)
        row, column = np.meshgrid(
            np.arange((bottom - top) // STRIDE), np.arange((right - left) // STRIDE), indexing="ij"
        )
        pixels = np.stack([left + STRIDE * (column + 0.5), top + STRIDE * (row + 0.5)], axis=-1)
        plane = config.projection.on_plane(pixels, config.scale * _PLANE)
        for name, values in (("_plane", plane), ("_pixels", pixels)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32, device=device), persistent=False)

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return the parameters in two groups: weights, and biases and scales, which do not decay."""
        weights = [one for one in self.parameters() if one.requires_grad and one.ndim > 1]
        others = [one for one in self.parameters() if one.requires_grad and one.ndim <= 1]
        return [{"params": weights}, {"params": others, "weight_decay": 0.0}]

    def reset(self) -> None:
        """Forget nothing: every image is looked at by itself."""

    # --- learning ----------------------------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch, and its parts for the log.

        Args:
            batch: images of `config.image_key`, shape (batch, 3, height, width), 0 to 1; and
                `observation.environment_state`.
        """
        image = self.checked(batch)
        labels = Labels.of(batch[OBS_ENV_STATE])
        is_true = is_placed = torch.ones(len(image), dtype=torch.bool, device=image.device)
        close = None
        if self.training:
            # What was found out of errors was of other weights.
            self._ratios.clear()
            self.factor.fill_(math.nan)
            image, is_true = self._varied(image)
            close, labels, is_placed = self._zoomed(image, labels)
        _, answers = self.look(image, close)
        if not self.training:
            self._calibrate(answers, labels)
        heat, place = self.nearness(labels)
        certain = torch.sigmoid(answers["presence"]) - heat
        # Nearly all cells are empty: what is answered right counts little (T.-Y. Lin et al., "Focal loss", 2017).
        presence = functional.binary_cross_entropy_with_logits(answers["presence"], heat, reduction="none")
        presence = (presence * certain.abs()).sum((1, 2)).mean()
        near = heat * (heat > _NEAR)
        at = labels.at(place)
        parts = self._errors(answers, at)
        parts["colour"] = parts["colour"] * is_true[:, None, None]
        means = {name: (part * near).sum() / near.sum().clamp_min(1.0) for name, part in parts.items()}
        placed = near * is_placed[:, None, None]
        across, error = (
            (part * placed).sum() / placed.sum().clamp_min(1.0) for part in self._place_errors(answers, at)
        )
        loss = 0.1 * presence + across + sum(_WEIGHTS[name] * value for name, value in means.items())
        assert isinstance(loss, Tensor)
        outputs = {name: float(value.detach()) for name, value in means.items() if name != "above"}
        return loss, {"presence": float(presence.detach()), **outputs, "error_mm": 1000 * float(error.detach())}

    def _varied(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return images in other light and shades; some in other colours; and whose colours are true, shape (batch,).

        What has other colours teaches nothing about colours, and that shape and place do not depend on them: cups are
        found to be cups in colours in which no cup was seen.
        """
        config, count, device = self.config, len(image), image.device
        if not (config.brightness or config.recolour or config.tint):
            return image, torch.ones(count, dtype=torch.bool, device=device)
        uniform = torch.rand(3, count, 1, 1, device=device)
        is_true = uniform[0] >= config.recolour
        # A mixture of the three channels for each of the three: new hues, or nearly none. A little of it, or of its
        # opposite, makes another shade. The rows' sums are 1, so that grey stays grey.
        mixture = torch.rand(count, 3, 3, device=device).square()
        mixture = mixture / mixture.sum(2, keepdim=True)
        share = torch.where(is_true, config.tint * (2 * uniform[1] - 1), 1.0)
        light = 1 + config.brightness * (2 * uniform[2] - 1)
        channels = light * torch.lerp(torch.eye(3, device=device).expand_as(mixture), mixture, share)
        image = torch.einsum("bij,bjhw->bihw", channels, image).to(image.dtype).clamp(0, 1)
        return image, is_true[:, 0, 0]

    def _zoomed(self, image: Tensor, labels: Labels) -> tuple[Tensor, Labels, Tensor]:
        """Return the region of the images, in most of them larger or smaller about a point; and what is true of it.

        In a part of an image that is twice as large, an object looks like one of twice the size: so objects of other
        sizes than those that there were are understood, too. Where it stands is not learned from that. A camera that
        stands elsewhere than it is taken to shows everything some pixels beside, twice as many in such a part, and the
        network knows that number from the whole image, which stays as it is.

        Returns:
            the region, shape (batch, 3, height, width); the labels; and whether x and y in them are to be learned,
            shape (batch,).
        """
        config, device = self.config, image.device
        left, top, right, bottom = config.region
        close = image[:, :, top:bottom, left:right]
        is_placed = torch.ones(len(image), dtype=torch.bool, device=device)
        if not config.zoom:
            return close, labels, is_placed
        factor, about = torch.ones(len(image), device=device), torch.zeros(len(image), 2, device=device)
        rows = (torch.rand(len(image), device=device) < _ZOOMED).nonzero()[:, 0]
        if len(rows):
            uniform = torch.rand(3, len(rows), device=device)
            largest, least = math.log1p(config.zoom), -math.log1p(2 * config.zoom)
            factor[rows] = torch.exp(least + (largest - least) * uniform[0])
            about[rows, 0], about[rows, 1] = left + uniform[1] * (right - left), top + uniform[2] * (bottom - top)
            x, y = (torch.arange(*ends, device=device) + 0.5 for ends in ((left, right), (top, bottom)))
            pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
            fixed = about[rows, None, None]
            source = fixed + (pixels - fixed) / factor[rows, None, None, None]
            size = torch.tensor(config.image_size, device=device)
            # `grid_sample` takes places in units of half the image, from its middle. What lies outside of it must not
            # be a mirror image: that would show objects where none are said to be.
            samples = functional.grid_sample(
                image[rows], 2 * source / size - 1, padding_mode="border", align_corners=False
            )
            close = close.index_copy(0, rows, samples)
            is_placed[rows] = False
        return close, labels.zoomed(config.projection, about.cpu().numpy(), factor.cpu().numpy()), is_placed

    def nearness(self, labels: Labels) -> tuple[Tensor, Tensor]:
        """Return how near every cell is to an object's centre, 0 to 1, and which object's, shape (batch, h, w)."""
        seen = self.config.projection.pixels(labels.position.detach().cpu().numpy().astype(np.float64))
        centre = torch.as_tensor(seen, dtype=torch.float32, device=self._plane.device)
        apart = (self._pixels - centre[:, :, None, None]).square().sum(-1) / STRIDE**2
        apart = apart.masked_fill(~labels.present[..., None, None], math.inf)
        least, place = apart.min(1)
        return torch.exp(-least / (2 * _SPREAD**2)), place

    def _errors(self, answers: Mapping[str, Tensor], true: Labels) -> dict[str, Tensor]:
        """Return the parts of the loss of every cell, as if each were near an object, shape (batch, h, w)."""
        above = (self.places(answers) - true.position)[..., 2].abs() / self._error
        turn = torch.stack([of(times * true.yaw) for times in (2, 4) for of in (torch.cos, torch.sin)], dim=-1)
        entropy = functional.cross_entropy(answers["colour"].movedim(-1, 1), true.colour, reduction="none")
        box = functional.binary_cross_entropy_with_logits(answers["is_box"], true.is_box, reduction="none")
        size = answers["size"] - torch.log(true.size.clamp_min(1e-3) / self._size)
        return {
            "above": above,
            "is_box": box,
            "colour": entropy,
            "size": size.abs().sum(-1),
            # A cup looks the same from all sides. With the absolute error nothing is learned for thousands of steps.
            "yaw": (answers["yaw"] - turn).square().sum(-1) * true.is_box,
        }

    def _place_errors(self, answers: Mapping[str, Tensor], true: Labels) -> tuple[Tensor, Tensor]:
        """Return the loss of x and y of every cell, and how far off they are [m], shape (batch, h, w)."""
        apart = (self.places(answers) - true.position)[..., :2].norm(dim=-1)
        scale = torch.exp(answers["log_error"].clamp(*_LOG_ERROR))
        return apart / self._error / scale + 2 * scale.log(), apart

    @torch.no_grad()
    def _calibrate(self, answers: Mapping[str, Tensor], labels: Labels) -> None:
        """Take the errors of a batch into account, together with those since the last step of training."""
        for row, found in enumerate(self._found(answers, factor=1.0)):
            true = labels.position[row][labels.present[row]]
            if not len(true) or not len(found.presence):
                continue
            apart = torch.cdist(found.position[:, :2], true[:, :2]).min(dim=1).values
            self._ratios.append(apart / found.scale)
        if self._ratios:
            ratios = torch.cat(self._ratios)
            # The quantile that also a further error stays below with this probability.
            share = min(1.0, _TAIL * (1 + 1 / max(1, len(ratios))))
            self.factor.copy_(torch.quantile(ratios, share) / _RADIUS)

    @torch.no_grad()
    def fit_camera(self, batches: Sequence[dict[str, Tensor]]) -> str:
        """Find where the camera stands now, look from there, and return what was found, as text."""
        self.eval()
        config, before = self.config, self.config.view
        for _ in range(_FITS):
            pairs = []
            for batch in batches:
                found = self._found(self.look(self.checked(batch))[1], factor=1.0)
                pairs.append(matched(found, Labels.of(batch[OBS_ENV_STATE]), config.projection))
            places, pixels = (np.concatenate(part) for part in zip(*pairs, strict=True))
            if len(places) < _LEAST_SEEN:
                raise ConfigError(
                    f"Of the objects on these tables {len(places)} were seen; to find where the camera stands, "
                    f"{_LEAST_SEEN} are needed. Record more tables, or train without --fine_tune_camera."
                )
            view = fit_view(before, config.image_size, places, pixels)
            config.camera_position, config.camera_target = list(view.position), list(view.target)
            config.camera_roll = view.roll
            self._aim()
        shift = 1000 * math.dist(before.position, view.position)
        lines = [np.subtract(one.target, one.position) for one in (before, view)]
        cosine = np.dot(*lines) / math.prod(float(np.linalg.norm(line)) for line in lines)
        turn, roll = math.degrees(math.acos(min(1.0, cosine))), math.degrees(view.roll - before.roll)
        return (
            f"The camera {config.camera!r} was moved by {shift:.0f} mm, turned by {turn:.1f} deg and rolled by "
            f"{roll:.1f} deg, by {len(places)} objects that were seen."
        )

    # --- seeing ------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def detect(self, images: Tensor) -> list[Detections]:
        """Return what is seen in images.

        Args:
            images: shape (batch, 3, height, width), 0 to 1.
        """
        if not bool(torch.isfinite(self.factor)):
            raise ConfigError(
                "This bhd_perception has no estimate of its errors: since its last training step it saw no held-out "
                "images, or found nothing in them. Train it with --dataset.eval_split=0.05 and --eval_steps=2000, and "
                "long enough. If a training was stopped, use the checkpoint before, or continue it."
            )
        self.eval()
        answers = self.look(self.checked({self.config.image_key: images}))[1]
        if not all(bool(torch.isfinite(values).all()) for values in answers.values()):
            raise ConfigError("This bhd_perception returns values that are not finite. Use another checkpoint.")
        return self._found(answers, float(self.factor))

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Raise an error: there are no actions."""
        raise ConfigError(
            "bhd_perception detects objects and gives no actions. Use it in a brain: --brain.type=language "
            "--brain.perception.path=CHECKPOINT."
        )

    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Raise an error: there are no actions."""
        return self.predict_action_chunk(batch)

    def checked(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return the images of a batch."""
        key, size = self.config.image_key, self.config.image_size
        image = batch.get(key)
        if image is None:
            raise ConfigError(f"{self.config.type} was trained with {key!r}, which is not in the batch.")
        if tuple(image.shape[1:]) != (3, size[1], size[0]):
            raise ConfigError(
                f"{self.config.type} was trained with images of {size[0]} x {size[1]} px; {key} has the shape "
                f"{tuple(image.shape[1:])} (channels, height, width)."
            )
        return image

    def look(self, image: Tensor, close: Tensor | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return what the network makes of images, cell by cell.

        Args:
            image: shape (batch, 3, height, width), 0 to 1.
            close: what is looked at closely; the region of the image, if nothing.

        Returns:
            features that it answers from, shape (batch, `config.channels`, h, w); and its answers by name, shape
            (batch, h, w) or (batch, h, w, numbers): logits of `presence`, `is_box` and `colour`; `shift`, `log_error`,
            `size` and `yaw` as the loss takes them.
        """
        features, colour = self.network(image, close)
        widths = {name: width for name, width in _OUTPUTS.items() if name != "colour"}
        values = self.network.answer(features).movedim(1, -1).split(list(widths.values()), dim=-1)
        answers = {name: part[..., 0] if widths[name] == 1 else part for name, part in zip(widths, values, strict=True)}
        return features, {**answers, "colour": colour.movedim(1, -1)}

    def places(self, answers: Mapping[str, Tensor]) -> Tensor:
        """Return where every cell states that the object near it is, in the base frame [m], shape (batch, h, w, 3)."""
        return self._plane + self._shift * answers["shift"]

    def _found(self, answers: Mapping[str, Tensor], factor: float) -> list[Detections]:
        presence = torch.sigmoid(answers["presence"])
        highest = functional.max_pool2d(presence[:, None], 5, stride=1, padding=2)[:, 0]
        is_peak = (presence == highest) & (presence > self.config.least_presence)
        position = self.places(answers)
        found = []
        for image in range(len(presence)):
            rows, columns = is_peak[image].nonzero(as_tuple=True)
            order = presence[image, rows, columns].argsort(descending=True, stable=True)
            cells = image, rows[order], columns[order]
            one = Detections(
                presence=presence[cells],
                position=position[cells],
                scale=factor * self._error * torch.exp(answers["log_error"][cells].clamp(*_LOG_ERROR)),
                is_box=torch.sigmoid(answers["is_box"][cells]),
                colour=torch.softmax(answers["colour"][cells], dim=-1),
                size=self._size * torch.exp(answers["size"][cells]),
                yaw=box_yaw(answers["yaw"][cells]),
            )
            found.append(_distinct(one, self.config.scale * _DISTINCT))
        return found


_WEIGHTS = {"above": 0.2, "is_box": 3.0, "colour": 1.0, "size": 2.0, "yaw": 10.0}


def box_yaw(answers: Tensor) -> Tensor:
    """Return yaws of boxes, from -pi/2 to pi/2 [rad], of cosine and sine of twice and of four times these, (k, 4).

    A box that is nearly square looks nearly the same after a quarter of a turn, and what is said of the double angle is
    then in between. Four times the angle is the same for both; the double angle only decides between quarters.
    """
    double, fourfold = (torch.atan2(one[:, 1], one[:, 0]) for one in answers.chunk(2, dim=1))
    half = fourfold / 2
    is_other = torch.cos(double - half) < 0
    double = half + torch.pi * is_other
    return torch.atan2(double.sin(), double.cos()) / 2


def _distinct(found: Detections, near: float) -> Detections:
    """Leave out what is nearer than this to something surer [m]."""
    apart = torch.cdist(found.position[:, :2], found.position[:, :2])
    kept: list[int] = []
    for row in range(len(apart)):
        if not kept or float(apart[row, kept].min()) > near:
            kept.append(row)
    return Detections(*(getattr(found, name)[kept] for name in found.__dataclass_fields__))


class _Network(nn.Module):
    """From an image to features of the cells of a region, shape (batch, channels, h, w), and logits of colours."""

    _region: Region
    _place: Tensor

    def __init__(self, config: PerceptionConfig) -> None:
        super().__init__()
        fine, coarse, context = config.channels, config.hidden, config.context
        # Cups and boxes that are small differ in a few pixels: more than one layer sees half of the resolution.
        self.stem = nn.Sequential(
            _convolution(3, 16, 5, stride=2),
            _convolution(16, 16, 3),
            _convolution(16, fine, 3, stride=2),
            _Residual(fine, 1),
        )
        self.down = _convolution(fine + 2, coarse, 3, stride=2)
        self.middle = nn.Sequential(_Residual(coarse, 1), _Residual(coarse, 2))
        self.up = _Convolution(coarse, fine, 1)
        self.join = _convolution(2 * fine, fine, 3)
        width, height = (math.ceil(size // 2 / 16) for size in config.image_size)
        self.overview = nn.Sequential(
            nn.AvgPool2d(2),
            _convolution(3, 16, 5, stride=2),
            _convolution(16, 24, 3, stride=2),
            _convolution(24, 32, 3, stride=2),
            _convolution(32, 32, 3, stride=2),
            nn.Flatten(),
            nn.Linear(32 * width * height, context),
            nn.ReLU(),
        )
        self.to_coarse, self.to_fine = nn.Linear(context, 2 * coarse), nn.Linear(context, 2 * fine)
        # What colour something has is told by what is seen of it close by, not by the features that tell its kind: a
        # network that has seen no blue box would else say that what is blue is no box, or what is a box not blue.
        self.shade, self.to_shade = _Convolution(3, _SHADES, 5, padding=2), nn.Linear(context, 2 * _SHADES)
        self.colour = nn.Sequential(nn.ReLU(inplace=True), _Convolution(_SHADES, len(COLOURS), 1))
        outputs = sum(_OUTPUTS.values()) - _OUTPUTS["colour"]
        self.answer = nn.Sequential(_Convolution(fine, 64, 1), nn.ReLU(inplace=True), _Convolution(64, outputs, 1))

    def aim(self, region: Region) -> None:
        """Look at a region of the images."""
        self._region = left, top, right, bottom = region
        rows, columns = ((size // STRIDE) for size in (bottom - top, right - left))
        y, x = (torch.linspace(-1, 1, count, device=self.up.weight.device) for count in (rows, columns))
        place = torch.stack(torch.meshgrid(x, y, indexing="xy"))[None]
        self.register_buffer("_place", place, persistent=False)

    def forward(self, image: Tensor, close: Tensor | None = None) -> tuple[Tensor, Tensor]:
        left, top, right, bottom = self._region
        whole, region = self.overview(image), image[:, :, top:bottom, left:right] if close is None else close
        shade = self.shade(functional.avg_pool2d(region, STRIDE))
        colour = self.colour(_modulated(shade, self.to_shade(whole.detach())))
        fine = self.stem(region)
        coarse = self.down(torch.cat([fine, self._place.expand(len(image), -1, -1, -1)], dim=1))
        coarse = self.up(self.middle(_modulated(coarse, self.to_coarse(whole))))
        coarse = functional.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
        joined = self.join(torch.cat([fine, coarse], dim=1))
        return _modulated(joined, self.to_fine(whole)), colour


def _modulated(values: Tensor, by: Tensor) -> Tensor:
    """Scale and shift channels (E. Perez et al., "FiLM", 2018)."""
    scale, shift = by[:, :, None, None].chunk(2, dim=1)
    return values * (1 + scale) + shift


def _convolution(inputs: int, outputs: int, size: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        _Convolution(inputs, outputs, size, stride, dilation * (size // 2), dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Convolution(nn.Conv2d):
    """One that computes with the channels side by side in memory: on a CPU, a step of training is a fifth faster.

    Its parameters are not stored that way: LeRobot does not save an optimizer's state that is.
    """

    def forward(self, values: Tensor) -> Tensor:
        weight = self.weight.contiguous(memory_format=torch.channels_last)
        return self._conv_forward(values, weight, self.bias)


class _Residual(nn.Module):
    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels, 3, dilation=dilation)
        self.second = nn.Sequential(
            _Convolution(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, values: Tensor) -> Tensor:
        return functional.relu(values + self.second(self.first(values)))
