"""`bhd_pixels`: from the first image of an episode, an instruction and the robot's state to a chunk of actions.

The network of ``bhd_perception`` says of each cell of the image what is near it. The instruction asks; the cell that
answers best is looked at, and from there a few others. What was seen so, once, and the robot's present state give the
actions. Only the first image is looked at because on later ones the arm is in front of what it is to grasp.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional

from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint
from bhd_lerobot.policies.mlp.objects_mlp import relative_features, relative_size
from bhd_lerobot.policies.mlp.residual_mlp import Residual
from bhd_lerobot.policies.mlp.statistics_mlp import KeepsStatistics, Statistics
from bhd_lerobot.policies.mlp.yaw_mlp import yaw
from bhd_lerobot.policies.perception.labels import Labels
from bhd_lerobot.policies.perception.modeling_perception import PerceptionPolicy
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig

_PADDING = "action_is_pad"
_TARGET = OBJECT_FIELDS.index("target")
_VALUES = 16  # numbers that each further place of the image gives
_SAME = (
    *("camera", "camera_position", "camera_target", "camera_fovy", "camera_roll"),
    *("area", "object_height", "scale", "margin", "image_size"),
)
_SHAPE = ("channels", "hidden", "context")
_SHARPNESS = 4  # attention is to fall off from an object's centre as this power of how near a cell is
_WITHIN = 0.03  # [m] cells whose places are so near to each other's are about the same object, of a UR5's measures
_THUMBNAIL = 8  # every so many pixels of an image, by which it is known again, with the sum of all
_KEPT = 16_384  # images of which it is kept what is known of their cells, some 35 kB each


class PixelsPolicy(KeepsStatistics, PreTrainedPolicy):
    """The policy type ``bhd_pixels``.

    Args:
        config: its shape and its features.
        initialise: begin with the weights of `config.perception`; not where a checkpoint's own follow.
        kwargs: what LeRobot passes to every policy; of it `dataset_stats` are used, for `config.residual`.
    """

    config_class = PixelsConfig
    name = "bhd_pixels"
    config: PixelsConfig

    def __init__(self, config: PixelsConfig, *, initialise: bool = True, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.perception = PerceptionPolicy(config)
        if config.perception and initialise:
            self._initialise(config.perception)
        self.perception.requires_grad_(not config.is_frozen)
        state = int(config.input_features[OBS_STATE].shape[0])  # type: ignore[index]
        columns = [column for column in range(state) if column not in config.ignored_columns]
        self.register_buffer("_columns", torch.tensor(columns, dtype=torch.long), persistent=False)
        left, bottom, right, top = config.area
        middle = [(left + right) / 2, (bottom + top) / 2, config.object_height / 2]
        self.register_buffer("_middle", torch.tensor(middle), persistent=False)
        self._state_mean: Tensor
        self._state_std: Tensor
        extent = [(right - left) / 2, (top - bottom) / 2, 0.05 * config.scale]
        self.register_buffer("_extent", torch.tensor(extent), persistent=False)
        self._action_size = int(config.output_features[ACTION].shape[0])  # type: ignore[index]
        cell = config.channels + self.perception.answer_size
        self.reader = _Reader(config.text_dim)
        self.named = _Attention(config.text_dim, cell, 1)
        self.others = _Attention(config.text_dim + cell, cell + 3, config.n_heads)
        self.value = nn.Linear(cell + 3, _VALUES)
        # Of the state before it was normalised; of a checkpoint, with its weights.
        self.register_buffer("_state_mean", torch.zeros(state))
        self.register_buffer("_state_std", torch.ones(state))
        width = len(columns) + cell + config.n_heads * _VALUES
        width += relative_size(1) if config.tool_columns else 0
        layers: list[nn.Module] = []
        for hidden in config.hidden_dims:
            layers += [nn.Linear(width, hidden), nn.GELU()]
            width = hidden
        self._yaw = 6 + len(COLOURS) + 3  # where `_look` puts the yaw
        self.actor = nn.Sequential(*layers, nn.Linear(width, config.chunk_size * self._action_size))
        self.residual: Residual | None = None
        if config.residual:
            self.residual = Residual(config.residual_columns, None, config.min_std)
        if kwargs.get("dataset_stats"):
            self.use_statistics(kwargs["dataset_stats"])
        self._looked: dict[tuple[bytes, int], tuple[Tensor, Tensor]] = {}
        self.reset()

    @classmethod
    def from_pretrained(cls, *args: Any, **kwargs: Any) -> "PixelsPolicy":
        """Return the policy of a checkpoint, with the checkpoint's own weights only; arguments are LeRobot's."""
        return super().from_pretrained(*args, **{**kwargs, "initialise": False})

    def set_statistics(self, stats: Statistics) -> None:
        """Set what states are given their units back by, and what actions begin at."""
        mean, std = (torch.as_tensor(stats[OBS_STATE][name], dtype=torch.float32) for name in ("mean", "std"))
        self._state_mean.copy_(mean)
        self._state_std.copy_(torch.where(std.isinf(), 0.0, std.clamp(min=self.config.min_std)))
        if self.residual is not None:
            self.residual.use_statistics(stats)

    def _initialise(self, path: str) -> None:
        from bhd_lerobot.policies.learned.policy import load_perception

        trained = load_perception(find_checkpoint(path), option="policy.perception")
        for name in (*_SAME, *_SHAPE):
            theirs, ours = getattr(trained.config, name), getattr(self.config, name)
            if theirs != ours:
                raise ConfigError(
                    f"policy.perception is {path!r}, whose {name} is {theirs}; here it is {ours}. Train one on images "
                    "of the same camera and size."
                )
        self.perception.load_state_dict(trained.state_dict())

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return the parameters in two groups: weights, and biases and scales, which do not decay."""
        weights = [one for one in self.parameters() if one.requires_grad and one.ndim > 1]
        others = [one for one in self.parameters() if one.requires_grad and one.ndim <= 1]
        return [{"params": weights}, {"params": others, "weight_decay": 0.0}]

    def train(self, mode: bool = True) -> "PixelsPolicy":
        """Switch to training, or not; what is not to be changed sees as it does afterwards."""
        super().train(mode)
        self.perception.train(mode and not self.config.is_frozen)
        return self

    def reset(self) -> None:
        """Forget what was seen and planned; at the start of an episode."""
        self._remembered: Tensor | None = None
        self._planned: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    # --- learning ----------------------------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a preprocessed batch, and its parts for the log.

        Args:
            batch: `observation.state`, shape (batch, 2, width), and `observation.environment_state`, shape (batch, 2,
                80), both of the episode's first frame and of the present one; `config.image_key`, shape (batch, 2, 3,
                height, width), likewise, or (batch, 3, height, width), of the first frame;
                `observation.language.tokens`, shape (batch, bytes); `action`, shape (batch, chunk_size, actions);
                `action_is_pad`, shape (batch, chunk_size), if any is.
        """
        config, image = self.config, self._first(batch)
        environment = batch[OBS_ENV_STATE][:, 0]
        parts: dict[str, Tensor] = {}
        if self.training and not config.is_frozen:
            sight = {config.image_key: image, OBS_ENV_STATE: environment}
            parts["perception"] = config.perception_weight * self.perception(sight)[0]
        cells, where = self._cells(image)
        seen, attention = self._see(cells, self._tokens(batch))
        parts["pointing"] = config.pointing_weight * self._astray(attention, where, environment)
        target = batch[ACTION]
        apart = (self._act(seen, batch[OBS_STATE][:, -1]) - target).abs()
        padding = batch.get(_PADDING)
        valid = torch.ones_like(apart[..., :1]) if padding is None else (~padding).unsqueeze(-1).to(apart.dtype)
        parts["action"] = (apart * valid).sum() / (valid.sum() * target.shape[-1]).clamp_min(1)
        total = torch.stack(list(parts.values())).sum()
        return total, {name: float(part.detach()) for name, part in parts.items()}

    def _astray(self, attention: Tensor, where: Tensor, environment: Tensor) -> Tensor:
        """Return how little of the attention to cells, shape (batch, cells), is where the named object is."""
        table = environment.reshape(len(environment), MAX_OBJECTS, len(OBJECT_FIELDS))
        labels = Labels.of(environment)
        alone = dataclasses.replace(labels, present=labels.present & (table[..., _TARGET] > 0.5))
        # Cells at the rim of an object were not taught where it is: they are not to have a say.
        near = self.perception.nearness(alone)[0].flatten(1).gather(1, where) ** _SHARPNESS
        near = near / near.sum(1, keepdim=True).clamp_min(1e-6)
        return -(near * attention.clamp_min(1e-6).log()).sum(1).mean()

    # --- acting ------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def see(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return what actions depend on beside the robot's state, from a first image, shape (batch, numbers).

        Args:
            batch: `config.image_key`, shape (batch, 3, height, width), and `observation.language.tokens`, shape (batch,
                bytes).
        """
        self.eval()
        return self._see(self._cells(self._first(batch))[0], self._tokens(batch))[0]

    @torch.no_grad()
    def act(self, seen: Tensor, batch: Mapping[str, Tensor]) -> Tensor:
        """Return normalised actions, shape (batch, chunk_size, actions).

        Args:
            seen: what `see` returned in the episode's first frame.
            batch: `observation.state`, normalised, shape (batch, width).
        """
        self.eval()
        if OBS_STATE not in batch:
            raise ConfigError(f"bhd_pixels was trained with {OBS_STATE!r}, which is not in the batch.")
        return self._act(seen, batch[OBS_STATE])

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return normalised actions, shape (batch, chunk_size, actions); of the images only the first since `reset`."""
        if self._remembered is None:
            self._remembered = self.see(batch)
        return self.act(self._remembered, batch)

    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action, normalised, shape (batch, actions); predict anew when the last chunk is used up."""
        if not self._planned:
            chunk = self.predict_action_chunk(batch)
            self._planned.extend(chunk[:, : self.config.n_action_steps].transpose(0, 1))
        return self._planned.popleft()

    def _first(self, batch: Mapping[str, Tensor]) -> Tensor:
        images = batch.get(self.config.image_key)
        if images is not None and images.ndim == 5:
            images = images[:, 0]
        return self.perception.checked({} if images is None else {self.config.image_key: images})

    def _tokens(self, batch: Mapping[str, Tensor]) -> Tensor:
        if OBS_LANGUAGE_TOKENS not in batch:
            raise ConfigError(f"{OBS_LANGUAGE_TOKENS} is not in the batch. Run the policy's own preprocessor first.")
        return batch[OBS_LANGUAGE_TOKENS]

    def _cells(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return what is known of the cells of images in which an object is likeliest, and which they are.

        Shapes (batch, cells, numbers) and (batch, cells).
        """
        if not (self.training and self.config.is_frozen):
            return self._look(image)
        # In a training the same first images come again and again.
        thumbnails = image[..., ::_THUMBNAIL, ::_THUMBNAIL].cpu().numpy()
        # Every pixel counts: integers, whose sum does not depend on the order, also where it overflows.
        sums = image.float().contiguous().view(torch.int32).flatten(1).sum(1, dtype=torch.int32).tolist()
        keys = [(one.tobytes(), number) for one, number in zip(thumbnails, sums, strict=True)]
        new = {key: row for row, key in enumerate(keys) if key not in self._looked}
        if new:
            # Each by itself: the last bits of a convolution depend on how many images there are, and a training that
            # was resumed looks at them in other batches.
            with torch.no_grad():
                looks = [self._look(image[row : row + 1]) for row in new.values()]
            self._looked.update({key: (cells[0], where[0]) for key, (cells, where) in zip(new, looks, strict=True)})
        found = [self._looked[key] for key in keys]
        for key in list(self._looked)[: max(0, len(self._looked) - _KEPT)]:
            del self._looked[key]  # images that are varied anew each time would fill the memory
        return torch.stack([cells for cells, _ in found]), torch.stack([where for _, where in found])

    def _look(self, image: Tensor) -> tuple[Tensor, Tensor]:
        features, answers = self.perception.look(image)
        presence = answers["presence"].flatten(1)
        where = presence.topk(min(self.config.n_cells, presence.shape[1]), dim=1).indices
        place = (self.perception.places(answers) - self._middle) / self._extent
        every = torch.cat(
            [
                place,
                answers["presence"].sigmoid().unsqueeze(-1),
                answers["log_error"].unsqueeze(-1).clamp(-4, 3),
                answers["is_box"].sigmoid().unsqueeze(-1),
                answers["colour"].log_softmax(-1).clamp_min(-8.0),
                answers["size"],
                answers["yaw"],
                features.movedim(1, -1),
            ],
            dim=-1,
        ).flatten(1, 2)
        return every.gather(1, where.unsqueeze(-1).expand(-1, -1, every.shape[-1])), where

    def _see(self, cells: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return what actions depend on, shape (batch, numbers), and where the named is, shape (batch, cells)."""
        bias = cells[..., 3].clamp_min(1e-4).log()  # where nothing is, nothing is meant
        said = self.reader(tokens)
        attention = self.named(said, cells, bias)
        named = torch.einsum("bn,bnc->bc", self._of_one(attention[:, 0], cells), cells)
        about = torch.cat([cells, cells[..., :3] - named[:, None, :3]], dim=-1)
        around = self.others(torch.cat([said, named], dim=-1), about, bias)
        further = torch.einsum("bhn,bnc->bhc", around, self.value(about))
        return torch.cat([named, further.flatten(1)], dim=-1), attention[:, 0]

    def _of_one(self, attention: Tensor, cells: Tensor) -> Tensor:
        """Return the attention, shape (batch, cells), to the object that has most of it, none to others; sums of 1.

        Half of it here and half there must not become a place between two objects.
        """
        place = cells[..., :2] * self._extent[:2]
        most = attention.argmax(1, keepdim=True).unsqueeze(-1).expand(-1, -1, 2)
        weight = attention * ((place - place.gather(1, most)).norm(dim=-1) < _WITHIN * self.config.scale)
        return weight / weight.sum(1, keepdim=True)

    def _act(self, seen: Tensor, state: Tensor) -> Tensor:
        values = torch.cat([state[:, self._columns], seen], dim=-1)
        if self.config.tool_columns:
            tool = (state * self._state_std + self._state_mean)[:, self.config.tool_columns]
            place = seen[:, :3] * self._extent + self._middle
            # Where the two are, and by how much what is named is turned; it is told by twice its yaw.
            turned = torch.atan2(seen[:, self._yaw + 1], seen[:, self._yaw]) / 2 - yaw(tool[:, 3:])
            relative = torch.cat([place - tool[:, :3], 2 * turned.unsqueeze(-1)], dim=-1)
            values = torch.cat([values, relative_features(relative, 1)], dim=-1)
        chunk: Tensor = self.actor(values).unflatten(-1, (self.config.chunk_size, self._action_size))
        return chunk if self.residual is None else chunk + self.residual(state)


class _Reader(nn.Module):
    """From bytes, shape (batch, length), 0 behind the end, to what is asked, shape (batch, size)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.letters = nn.Embedding(257, 32, padding_idx=0)
        self.near = nn.Conv1d(32, 64, 5, padding=2)
        self.far = nn.Conv1d(64, 64, 5, padding=4, dilation=2)
        self.said = nn.Linear(64, size)

    def forward(self, tokens: Tensor) -> Tensor:
        # Each sentence of a batch once, and nothing behind the end of the longest: the same answer in a quarter of the
        # time, most of which a training would spend here.
        length = int((tokens != 0).sum(1).max())
        tokens, which = torch.unique(tokens[:, : max(1, length)], dim=0, return_inverse=True)
        is_end = (tokens == 0).unsqueeze(1)
        values = functional.relu(self.near(self.letters(tokens).transpose(1, 2))).masked_fill(is_end, 0.0)
        values = functional.relu(self.far(values)).masked_fill(is_end, 0.0)
        result: Tensor = self.said(values.amax(-1))[which]
        return result


class _Attention(nn.Module):
    """Which of some cells a question is answered by, for several questions: shape (batch, heads, cells), sums of 1."""

    def __init__(self, question: int, cell: int, heads: int, size: int = 32) -> None:
        super().__init__()
        self._heads, self._scale = heads, 1 / math.sqrt(size)
        self.question = nn.Sequential(nn.Linear(question, 128), nn.GELU(), nn.Linear(128, heads * size))
        self.key = nn.Linear(cell, size)

    def forward(self, question: Tensor, cells: Tensor, bias: Tensor) -> Tensor:
        asked = self.question(question).unflatten(-1, (self._heads, -1))
        score = self._scale * torch.einsum("bhd,bnd->bhn", asked, self.key(cells)) + bias.unsqueeze(1)
        return score.softmax(-1)
