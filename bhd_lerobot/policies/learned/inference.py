"""From observations to chunks of actions: batched where a policy lets us, one copy a simulation where it does not."""

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    NormalizerProcessorStep,
    RenameObservationsProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from bhd_lerobot.errors import ConfigError, as_text
from bhd_lerobot.policies.learned.policy import LoadedPolicy, torch_device
from bhd_lerobot.stock import ACTTemporalEnsembler

type Rows = dict[str, NDArray]
"""Observations of some simulations: by key, shape (simulations, frames, …), oldest first; images uint8 (…, h, w, 3).
Images are missing where they are not looked at."""

# Steps that treat every number by itself, so that a batch, a history or a chunk may go through them in one piece; those
# of this package say so themselves.
_ELEMENTWISE = (
    RenameObservationsProcessorStep,
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    NormalizerProcessorStep,
    UnnormalizerProcessorStep,
)
_PERCEPTRONS = ("bhd_mlp", "bhd_cnn")
_SMALL = 2_000_000  # parameters; below, a second thread costs more than it does
_BLOCK, _BLOCK_LARGE = 64, 8


class Inference(Protocol):
    """What turns observations into actions."""

    frames: tuple[int, ...]
    """Which frames `infer` needs, oldest first, the present one being 0."""
    steps: int
    """How many actions of a chunk are carried out."""
    looks_once: bool
    """Whether it uses the images of an episode's first frame only."""

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str]) -> None:
        """Start episodes in some of n simulations; a seed and an instruction for each of them."""

    def infer(self, ids: NDArray[np.intp], rows: Rows) -> NDArray[np.float32]:
        """Return chunks, in the robot's units, shape (len(ids), at least `steps`, actions)."""


def make_inference(loaded: LoadedPolicy, *, sample: bool, exact: bool, threads: int | None) -> Inference:
    """Return what drives simulations with a policy; the options are those of `LearnedBrainConfig`."""
    if sample and not getattr(loaded.config, "gaussian", False):
        raise ConfigError("brain.sample is true, but this policy has no distribution (bhd_mlp with gaussian=true has).")
    if threads is None and sum(p.numel() for p in loaded.policy.parameters()) < _SMALL:
        threads = 1
    steps = (*loaded.before.steps, *loaded.after.steps)
    is_plain = all(isinstance(step, _ELEMENTWISE) or getattr(step, "is_elementwise", False) for step in steps)
    if is_plain and loaded.kind in (*_PERCEPTRONS, "bhd_pixels", "act", "diffusion"):
        return BatchedInference(loaded, sample=sample, exact=exact, threads=threads)
    return StockInference(loaded, threads=threads)


class BatchedInference:
    """One forward pass for all simulations that need one: `bhd_mlp`, `bhd_cnn`, `bhd_pixels`, ACT and Diffusion.

    The policy keeps nothing between two calls: histories and chunks belong to the caller, the averages of ACT's
    temporal ensembling, what `bhd_pixels` saw first and the random numbers to each simulation.

    Simulations go through the network in blocks of a fixed size, because the last bits of a matrix product depend on
    how many rows it has. So an episode's actions do not depend on what is beside it; alone (n = 1), or with `exact`,
    they are the bits of LeRobot's own `select_action`.
    """

    def __init__(self, loaded: LoadedPolicy, *, sample: bool, exact: bool, threads: int | None) -> None:
        self.loaded, self._exact, self._threads = loaded, exact, threads
        config, self._kind = loaded.config, loaded.kind
        self._sample = self._kind in _PERCEPTRONS and (sample or config.sample)
        self.steps = int(config.n_action_steps)
        self.looks_once = self._kind == "bhd_pixels"
        self.frames = (0,) if self.looks_once else tuple(config.observation_delta_indices or (0,))
        self._device = torch_device(loaded)
        self._block = 1
        coefficient = getattr(config, "temporal_ensemble_coeff", None)
        self._coefficient: float | None = None if self._kind != "act" else coefficient
        self._ensemblers: dict[int, ACTTemporalEnsembler] = {}
        self._generators: dict[int, torch.Generator] = {}
        self._instructions: dict[int, str] = {}
        self._seen: dict[int, Tensor] = {}

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str]) -> None:
        """Start episodes: new random numbers, no average yet, and nothing seen."""
        large = self._kind in ("act", "diffusion")
        self._block = 1 if n == 1 or self._exact else _BLOCK_LARGE if large else _BLOCK
        for i, (sim, seed) in enumerate(zip(ids.tolist(), seeds, strict=True)):
            self._instructions[sim] = instructions[i] if i < len(instructions) else ""
            self._seen.pop(sim, None)
            self._generators[sim] = torch.Generator(self._device).manual_seed(seed)
            if self._coefficient is not None:
                self._ensemblers[sim] = ACTTemporalEnsembler(self._coefficient, self.loaded.config.chunk_size)

    def infer(self, ids: NDArray[np.intp], rows: Rows) -> NDArray[np.float32]:
        """Return chunks, shape (len(ids), predicted actions, actions)."""
        chunks = []
        with torch.inference_mode(), use_threads(self._threads), self.loaded.precision():
            for start in range(0, len(ids), self._block):
                sims = ids[start : start + self._block].tolist()
                block = {key: _filled(values[start : start + self._block], self._block) for key, values in rows.items()}
                batch = self._batch(block)
                if self._kind == "bhd_pixels":
                    texts = [self._instructions[sim] for sim in sims]
                    batch["task"] = texts + texts[:1] * (self._block - len(texts))
                chunk = self.loaded.after(self._predict(sims, self.loaded.before(batch)))
                chunks.append(chunk[: len(sims)].to("cpu", torch.float32).numpy())
        return np.concatenate(chunks)

    def _batch(self, block: Rows) -> dict[str, Any]:
        """Return tensors as LeRobot's evaluation gives them: float, images channels first and in [0, 1]."""
        has_history = self._kind == "diffusion" or len(self.frames) > 1
        batch: dict[str, Any] = {}
        for key, values in block.items():
            tensor = torch.from_numpy(np.ascontiguousarray(values if has_history else values[:, -1]))
            batch[key] = image_tensor(tensor) if tensor.dtype == torch.uint8 else tensor
        return batch

    def _predict(self, sims: list[int], batch: dict[str, Any]) -> Tensor:
        policy = self.loaded.policy
        if self._kind == "diffusion":
            return self._diffuse(sims, batch)
        if self._kind in _PERCEPTRONS:
            if not self._sample:
                return policy.predict_action_chunk(batch)
            return policy.predict_action_chunk(batch, noise=self._noise(sims, self.loaded.config.chunk_size))
        if self._kind == "bhd_pixels":
            new = [row for row, sim in enumerate(sims) if sim not in self._seen]
            if new:
                seen = policy.see(batch)
                self._seen |= {sims[row]: seen[row] for row in new}
            rows = [self._seen[sim] for sim in sims]
            return policy.act(torch.stack(rows + rows[:1] * (self._block - len(rows))), batch)
        chunk = policy.predict_action_chunk(batch)
        if self._coefficient is None:
            return chunk
        rows = [self._ensemblers[sim].update(chunk[i : i + 1]) for i, sim in enumerate(sims)]
        return torch.stack(rows, dim=1).transpose(0, 1).reshape(len(sims), 1, -1)

    def _diffuse(self, sims: list[int], batch: dict[str, Any]) -> Tensor:
        """Return Diffusion's chunks; every step of its sampling draws from the simulation's own generator."""
        config, model = self.loaded.config, self.loaded.policy.diffusion
        if config.image_features:
            batch = {**batch, OBS_IMAGES: torch.stack([batch[key] for key in config.image_features], dim=-4)}
        noise = self._noise(sims, config.horizon)
        spare = [torch.Generator(self._device)] * (self._block - len(sims))
        generators = [self._generators[sim] for sim in sims] + spare
        # `predict_action_chunk` would be nearer, but takes no generator.
        condition = model._prepare_global_conditioning(batch)
        actions = model.conditional_sample(
            batch[OBS_STATE].shape[0],
            global_cond=condition,
            noise=noise,
            generator=generators if len(generators) > 1 else generators[0],
        )
        first = config.n_obs_steps - 1
        return actions[:, first : first + config.n_action_steps]

    def _noise(self, sims: list[int], length: int) -> Tensor:
        """Return normal random numbers, shape (block, length, actions), every row from its own generator."""
        shape = (1, length, self.loaded.width(ACTION) or 0)
        drawn = [torch.randn(shape, generator=self._generators[sim], device=self._device) for sim in sims]
        return torch.cat(drawn + [torch.zeros(shape, device=self._device)] * (self._block - len(sims)))


class StockInference:
    """LeRobot's own `select_action`, with a copy of the policy for every simulation: any policy there is.

    Of a policy that has chunks and no `select_action`, the first `n_action_steps` of each chunk are carried out.
    The copies share the weights; only what a policy remembers is theirs. One simulation after the other, so n of them
    take n times as long as one.
    """

    frames: tuple[int, ...] = (0,)
    steps: int = 1
    looks_once = False

    def __init__(self, loaded: LoadedPolicy, *, threads: int | None) -> None:
        self.loaded, self._threads = loaded, threads
        self._policies: dict[int, Any] = {}
        self._chunks: dict[int, list[Tensor]] = {}
        self._random: dict[int, list[Tensor]] = {}
        self._instructions: dict[int, str] = {}
        device = torch_device(loaded)
        self._cuda = [device.index or 0] if device.type == "cuda" else []

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str]) -> None:
        """Start episodes: everything that the policy remembers is forgotten."""
        for i, (sim, seed) in enumerate(zip(ids.tolist(), seeds, strict=True)):
            if sim not in self._policies:
                self._policies[sim] = _twin(self.loaded.policy)
            self._policies[sim].reset()
            self._chunks[sim] = []
            self._instructions[sim] = instructions[i] if i < len(instructions) else ""
            with torch.random.fork_rng(self._cuda):
                torch.manual_seed(seed)
                self._random[sim] = self._random_state()

    def infer(self, ids: NDArray[np.intp], rows: Rows) -> NDArray[np.float32]:
        """Return the next action of every simulation, shape (len(ids), 1, actions)."""
        actions = []
        with torch.inference_mode(), use_threads(self._threads), self.loaded.precision():
            for row, sim in enumerate(ids.tolist()):
                batch: dict[str, Any] = {"task": [self._instructions[sim]]}
                for key, values in rows.items():
                    tensor = torch.from_numpy(np.ascontiguousarray(values[row : row + 1, -1]))
                    batch[key] = image_tensor(tensor) if tensor.dtype == torch.uint8 else tensor
                with torch.random.fork_rng(self._cuda):
                    torch.set_rng_state(self._random[sim][0])
                    if self._cuda:
                        torch.cuda.set_rng_state(self._random[sim][1], self._cuda[0])
                    action = self.loaded.after(self._next_action(sim, self.loaded.before(batch)))
                    self._random[sim] = self._random_state()
                actions.append(action.to("cpu", torch.float32).numpy())
        return np.stack(actions)

    def _next_action(self, sim: int, batch: dict[str, Any]) -> Tensor:
        policy, chunk = self._policies[sim], self._chunks[sim]
        if not chunk:
            try:
                return policy.select_action(batch)
            except NotImplementedError as error:
                chunk += self._predict(policy, batch, error)
        return chunk.pop(0)

    def _predict(self, policy: Any, batch: dict[str, Any], missing: NotImplementedError) -> tuple[Tensor, ...]:
        """Return the actions of a chunk that are carried out, each of shape (1, actions)."""
        try:
            chunk = policy.predict_action_chunk(batch)
        except Exception as error:  # whatever it wants besides
            reason = as_text(error)
            raise ConfigError(
                f"The policy type {self.loaded.kind!r} cannot be executed here: it gives no single actions "
                f"({' '.join(str(missing).split()) or 'no select_action'}), and no chunk for an observation alone "
                f"({reason}). Run it with the program that it was made for."
            ) from error
        steps = getattr(self.loaded.config, "n_action_steps", None) or chunk.shape[1]
        return chunk[:, :steps].unbind(1)

    def _random_state(self) -> list[Tensor]:
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state(index) for index in self._cuda)]


def image_tensor(pixels: Tensor) -> Tensor:
    """Return images, uint8, shape (…, height, width, channels), as float32 in [0, 1], channels first."""
    last = pixels.ndim - 1
    order = (*range(last - 2), last, last - 2, last - 1)
    return pixels.permute(order).contiguous().type(torch.float32) / 255


def _filled(values: NDArray, size: int) -> NDArray:
    """Return a block of exactly `size` rows; the first row stands in for those that are missing."""
    missing = size - len(values)
    return values if missing <= 0 else np.concatenate([values, np.repeat(values[:1], missing, axis=0)])


def _twin(policy: Any) -> Any:
    """Return a copy that shares the weights."""
    shared = {id(tensor): tensor for tensor in (*policy.parameters(), *policy.buffers())}
    return copy.deepcopy(policy, shared)


@contextmanager
def use_threads(count: int | None) -> Iterator[None]:
    """Give torch some threads for a while."""
    before = torch.get_num_threads()
    if count is None or count == before:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def expected_frames(frames: Sequence[int]) -> int:
    """Return how many frames have to be remembered, the present one included."""
    return math.ceil(1 - min(frames))
