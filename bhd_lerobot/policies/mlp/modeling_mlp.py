"""`bhd_mlp`: a perceptron from the robot's numbers to a chunk of actions. Small, and fast without a GPU."""

import math
from collections import deque
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.mlp.objects_mlp import OBS_RELATIVE, relative_features, relative_size
from bhd_lerobot.policies.mlp.residual_mlp import Residual
from bhd_lerobot.policies.mlp.scan_mlp import OBS_SCAN, ScanEncoder, other_columns, transformed
from bhd_lerobot.policies.mlp.statistics_mlp import KeepsStatistics, Statistics
from bhd_lerobot.policies.mlp.target_mlp import OBS_TARGET, TARGET_SIZE, target_features
from bhd_lerobot.policies.mlp.yaw_mlp import OBS_YAW, harmonics

ACTIVATION_LAYERS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "gelu": nn.GELU,
    "silu": nn.SiLU,
    "elu": nn.ELU,
}
_LOG_STD = (-5.0, 2.0)  # a standard deviation that goes to 0 makes the loss go to minus infinity
_MODE_SCALE = 0.1  # of a Laplace distribution about each mode, in normalised actions
_PADDING = "action_is_pad"
_PREPROCESSED = " Run the policy's own preprocessor first."
_HINTS = {
    OBS_ENV_STATE: " It comes from a task; a robot's own sensors, and so lerobot-rollout, lack it. Run this policy in "
    "bhd-eval or lerobot-eval, or train one on the sensors alone: "
    "--policy.input_features='{observation.state: {type: STATE, shape: [WIDTH]}}'.",
}


class MlpPolicy(KeepsStatistics, PreTrainedPolicy):
    """The policy type ``bhd_mlp``.

    `features` turns a preprocessed batch into one vector a row, and `net`, a `torch.nn.Sequential` of linear layers and
    activations, turns that into the chunk.
    """

    config_class = MlpConfig
    name = "bhd_mlp"
    config: MlpConfig

    def __init__(self, config: MlpConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        state, environment, action = config.robot_state_feature, config.env_state_feature, config.action_feature
        if action is None:
            raise AssertionError("The configuration was validated.")
        self._action_size = int(action.shape[0])
        state_size = int(state.shape[0]) if state else 0
        environment_size = int(environment.shape[0]) if environment else 0
        self._keys = [key for key, width in ((OBS_STATE, state_size), (OBS_ENV_STATE, environment_size)) if width]
        self._kept_keys = [*self._keys, OBS_SCAN, OBS_YAW, OBS_RELATIVE, OBS_TARGET]  # of which a history is kept
        scan, steps = config.scan, config.n_obs_steps
        columns = other_columns(state_size, scan.start or 0, scan.beams if scan.is_used else 0, config.ignored_columns)
        # Not part of the checkpoint: the configuration says it.
        self.register_buffer("_columns", torch.tensor(columns, dtype=torch.long), persistent=False)
        activation = ACTIVATION_LAYERS[config.activation]
        self.scan_encoder = ScanEncoder(scan, steps, activation) if scan.is_used and scan.channels else None
        self._beams = 0 if not scan.is_used else self.scan_encoder.size if self.scan_encoder else steps * scan.beams
        yaws = 2 * config.yaw_harmonics * config.quaternions
        self._is_relative = config.sort_objects and bool(config.tool_columns)
        relative = relative_size(config.yaw_harmonics) if self._is_relative else 0
        relative += TARGET_SIZE if config.relative_target else 0
        self.feature_size = (
            steps * (len(columns) + environment_size + yaws + relative) + self._beams + config.sight_size
        )
        outputs = config.modes * config.chunk_size * self._action_size + (config.modes if config.modes > 1 else 0)
        self.net = nn.Sequential(*_perceptron(config, self.feature_size, outputs))
        self.residual: Residual | None = None
        if config.residual:
            self.residual = Residual(
                config.residual_columns, kwargs.get("dataset_stats"), config.min_std, config.residual_quaternions
            )
        self.log_std: nn.Parameter | None = None
        if config.gaussian:
            shape = (config.chunk_size, self._action_size)
            self.log_std = nn.Parameter(torch.full(shape, float(config.initial_log_std)))
        self.reset()

    def set_statistics(self, stats: Statistics) -> None:
        """Set what actions begin at."""
        if self.residual is not None:
            self.residual.use_statistics(stats)

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return the parameters in two groups: weights, and biases and scales, which do not decay."""
        weights = [p for p in self.parameters() if p.requires_grad and p.ndim > 1 and p is not self.log_std]
        others = [p for p in self.parameters() if p.requires_grad and (p.ndim <= 1 or p is self.log_std)]
        return [{"params": weights}, {"params": others, "weight_decay": 0.0}]

    def reset(self) -> None:
        """Forget what was seen and planned; at the start of an episode."""
        self._seen: dict[str, deque[Tensor]] = {}
        self._planned: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def features(self, batch: dict[str, Tensor]) -> Tensor:
        """Return what the network sees.

        Args:
            batch: `observation.state` and `observation.environment_state` as the preprocessor gives them, shape
                (batch, width) or, oldest first, (batch, n_obs_steps, width).

        Returns:
            shape (batch, feature_size): of each observation, oldest first, the state without beams, the environment
            state, cosines and sines of yaws, and where what is meant, and the target, is from the tool; then the beams.
        """
        config = self.config
        rows = {key: self._history(batch, key) for key in self._keys}
        parts, scan = [], None
        if OBS_STATE in rows:
            state = rows[OBS_STATE]
            if config.scan.is_used:
                first = config.scan.start or 0
                scan = self._clipped(state[..., first : first + config.scan.beams])
            parts.append(state[..., self._columns])
        if OBS_ENV_STATE in rows:
            parts.append(rows[OBS_ENV_STATE])
        if config.yaw_harmonics:
            parts.append(harmonics(self._history(batch, OBS_YAW), config.yaw_harmonics))
        if self._is_relative:
            parts.append(relative_features(self._history(batch, OBS_RELATIVE), config.yaw_harmonics))
        if config.relative_target:
            parts.append(target_features(self._history(batch, OBS_TARGET)))
        numbers = self._clipped(torch.cat(parts, dim=-1)).flatten(1)
        if scan is None:
            return numbers
        if config.scan.transform != "none":
            scan = transformed(self._history(batch, OBS_SCAN), config.scan)
        beams = scan.flatten(1) if self.scan_encoder is None else self.scan_encoder(scan)
        return torch.cat([numbers, beams], dim=-1)

    def features_in(self, other: "MlpPolicy") -> list[int]:
        """Return where this policy's features are among those of another, which sees more.

        Both are to have the same configuration, but the other may ignore fewer columns and may see more observations,
        of which the last are this policy's.
        """
        own, others = self._columns.tolist(), other._columns.tolist()
        steps, beams = self.config.n_obs_steps, self._beams
        rest = (self.feature_size - beams) // steps - len(own)  # environment state and yaws, the same in both
        of_step = [*(others.index(column) for column in own), *range(len(others), len(others) + rest)]
        width = len(others) + rest
        first = other.config.n_obs_steps - steps
        numbers = [step * width + place for step in range(first, first + steps) for place in of_step]
        return numbers + list(range(other.feature_size - beams, other.feature_size))

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a preprocessed batch, and its parts for the log.

        Padded actions, beyond an episode's end, do not count.

        Args:
            batch: observations as in `features`; `action`, shape (batch, chunk_size, actions); `action_is_pad`, shape
                (batch, chunk_size), if any is.
            reduction: ``"mean"``, or ``"none"`` for one loss a row, shape (batch,).
        """
        return self._compared(self.features(batch), batch, reduction)

    def _compared(self, features: Tensor, batch: dict[str, Tensor], reduction: str) -> tuple[Tensor, dict[str, float]]:
        """Return what `forward` returns, given what the network sees."""
        chunks, logits = self._chunks(features, batch)
        target = batch[ACTION]
        target = target.unsqueeze(1) if target.ndim == 2 else target
        if self.residual is not None:
            target = self.residual.nearer(target, self._history(batch, OBS_STATE)[:, -1])
        target = target.unsqueeze(1)
        loss = self._loss(chunks, target)
        padding = batch.get(_PADDING)
        valid = torch.ones_like(target[..., :1]) if padding is None else (~padding)[:, None, :, None].to(loss.dtype)
        numbers = (valid.sum((1, 2, 3)) * target.shape[-1]).clamp_min(1)
        # Of a mixture: what is nearest to the target learns from it, and that it was the one to choose.
        scale = _MODE_SCALE * numbers
        mixed = torch.log_softmax(logits, dim=1) - (loss * valid).sum((2, 3)) / scale.unsqueeze(1)
        loss = -scale * mixed.logsumexp(1)
        chosen = chosen_mode(chunks.detach(), logits)
        error = (chosen - target[:, 0]).abs() * valid[:, 0]
        outputs = {"l1_loss": float(error.sum() / (valid.sum() * target.shape[-1]))}
        if self.log_std is not None:
            outputs["std"] = float(self._std().detach().mean())
        if reduction == "none":
            return loss / numbers, outputs
        return loss.sum() / (valid.sum() * target.shape[-1]).clamp_min(1), outputs

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], noise: Tensor | None = None, **_: Any) -> Tensor:
        """Return normalised actions, shape (batch, chunk_size, actions).

        `noise`: of a standard normal distribution, in the result's shape: act on the sample that it makes, instead of
        the mean.
        """
        self.eval()
        mean = self._chunk(self.features(batch), batch)
        if noise is None and self.config.sample:
            noise = torch.randn_like(mean)
        if noise is None:
            return mean
        if self.log_std is None:
            raise ConfigError("This bhd_mlp was not trained with gaussian=true: there is nothing to sample from.")
        return mean + self._std() * noise

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], noise: Tensor | None = None, **_: Any) -> Tensor:
        """Return the next action, normalised, shape (batch, actions); look again when the last chunk is used up."""
        for key in self._kept_keys:
            if key not in batch:
                continue
            seen = self._seen.setdefault(key, deque(maxlen=self.config.history))
            # As in the dataset, nothing was before an episode's first frame but that frame.
            seen.extend([batch[key]] * (1 if seen else self.config.history))
        if not self._planned:
            stride = self.config.obs_stride
            history = {key: torch.stack(list(seen)[::stride], dim=1) for key, seen in self._seen.items()}
            chunk = self.predict_action_chunk(history, noise)
            self._planned.extend(chunk[:, : self.config.n_action_steps].transpose(0, 1))
        return self._planned.popleft()

    def _chunk(self, features: Tensor, batch: dict[str, Tensor]) -> Tensor:
        return chosen_mode(*self._chunks(features, batch))

    def _chunks(self, features: Tensor, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the chunk of each mode, shape (batch, modes, chunk_size, actions), and the modes' logits."""
        chunks, logits = self.split_modes(self.net(features))
        if self.residual is not None:
            chunks = chunks + self.residual(self._history(batch, OBS_STATE)[:, -1]).unsqueeze(1)
        return chunks, logits

    def split_modes(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Split what the network says into chunks, shape (batch, modes, chunk_size, actions), and the modes' logits."""
        shape = (self.config.modes, self.config.chunk_size, self._action_size)
        chunks, logits = outputs.tensor_split([math.prod(shape)], dim=-1)
        return chunks.unflatten(-1, shape), logits if self.config.modes > 1 else outputs.new_zeros(len(outputs), 1)

    def _history(self, batch: dict[str, Tensor], key: str) -> Tensor:
        """Return an input, shape (batch, n_obs_steps, width)."""
        values = batch.get(key)
        if values is None:
            hint = _HINTS.get(key, "" if key in self._keys else _PREPROCESSED)
            raise ConfigError(f"{self.name} was trained with {key!r}, which is not in the batch.{hint}")
        values = values.unsqueeze(1) if values.ndim == 2 else values
        if values.shape[1] != self.config.n_obs_steps:
            raise ConfigError(
                f"{key} holds {values.shape[1]} observations; policy.n_obs_steps is {self.config.n_obs_steps}."
            )
        return values

    def _clipped(self, values: Tensor) -> Tensor:
        limit = self.config.feature_clip
        return values if limit is None else values.clamp(-limit, limit)

    def _std(self) -> Tensor:
        if self.log_std is None:
            raise AssertionError("Only a Gaussian policy has a standard deviation.")
        return self.log_std.clamp(*_LOG_STD).exp()

    def _loss(self, mean: Tensor, target: Tensor) -> Tensor:
        """Return the loss of every number, in the shape of what was predicted."""
        target = target.expand_as(mean)
        match self.config.loss_name:
            case "l1":
                return functional.l1_loss(mean, target, reduction="none")
            case "mse":
                return functional.mse_loss(mean, target, reduction="none")
            case "huber":
                return functional.huber_loss(mean, target, reduction="none", delta=self.config.huber_delta)
        std = self._std()
        return 0.5 * ((target - mean) / std) ** 2 + std.log() + 0.5 * math.log(2 * math.pi)


def chosen_mode(chunks: Tensor, logits: Tensor) -> Tensor:
    """Return the chunk of the likeliest mode, shape (batch, chunk_size, actions); see `MlpPolicy.split_modes`."""
    return chunks[torch.arange(len(chunks), device=chunks.device), logits.argmax(1)]


def _perceptron(config: MlpConfig, inputs: int, outputs: int) -> list[nn.Module]:
    modules: list[nn.Module] = []
    for width in config.hidden_dims:
        modules.append(nn.Linear(inputs, width))
        modules += [nn.LayerNorm(width)] * config.layer_norm
        modules.append(ACTIVATION_LAYERS[config.activation]())
        modules += [nn.Dropout(config.dropout)] * (config.dropout > 0)
        inputs = width
    return [*modules, nn.Linear(inputs, outputs)]
