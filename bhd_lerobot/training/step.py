"""One training step: what LeRobot's `update_policy` computes, to the same bits, without waiting for the device."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bhd_lerobot.stock import has_method

Batch = dict[str, Any]


@dataclass(frozen=True)
class StepResult:
    """What a step measured, the norm before clipping; tensors on the device, so that a step does not wait for them."""

    loss: Tensor
    grad_norm: Tensor
    outputs: Mapping[str, Any]


class NonFiniteError(ArithmeticError):
    """The loss, or the gradient's norm, is not finite: its name and value; the weights are as before the step."""


class Learner:
    """A policy with its optimizer."""

    def __init__(
        self,
        policy: Any,
        optimizer: Any,
        scheduler: Any,
        accelerator: Any,
        *,
        preprocessor: Callable[[Batch], Batch],
        grad_clip_norm: float,
        camera_keys: tuple[str, ...] = (),
    ) -> None:
        """Keep what a step needs; the gradient is not clipped if `grad_clip_norm` is not positive; images are 8 bit."""
        self.unwrapped = policy
        # For one process in full precision, accelerate's wrappers change nothing and take longer than a small network.
        self._is_plain = accelerator.num_processes == 1 and accelerator.mixed_precision == "no"
        if not self._is_plain:
            policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
        self.policy, self.optimizer, self.scheduler = policy, optimizer, scheduler
        self._accelerator, self._preprocessor, self._camera_keys = accelerator, preprocessor, camera_keys
        self._grad_clip_norm = grad_clip_norm
        self.skips_overflows = accelerator.mixed_precision == "fp16"
        """Whether a gradient that is not finite is no error: it changes nothing but its own scale."""
        self._checks_at_once = accelerator.device.type == "cpu" and accelerator.num_processes == 1
        self._update_buffers = self.unwrapped.update if has_method(self.unwrapped, "update") else None
        self.policy.train()

    def state_dict(self) -> dict[str, Any]:
        """Return what the optimizer's state does not hold, as JSON values: of half precision the gradients' scale."""
        scaler = self._accelerator.scaler
        return {} if scaler is None else scaler.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        if state and self._accelerator.scaler is not None:
            self._accelerator.scaler.load_state_dict(state)

    @property
    def lr(self) -> float:
        """The learning rate."""
        return float(self.optimizer.param_groups[0]["lr"])

    def prepare(self, batch: Batch) -> Batch:
        """Return the policy's input for a batch of the dataset."""
        for key in self._camera_keys:
            if key in batch and batch[key].dtype == torch.uint8:
                batch[key] = batch[key].to(dtype=torch.float32).div_(255.0)
        return self._preprocessor(batch)

    def step(self, batch: Batch) -> StepResult:
        """Learn from a batch that `prepare` returned."""
        with nullcontext() if self._is_plain else self._accelerator.autocast():
            loss, outputs = self.policy.forward(batch)
        if self._checks_at_once and not bool(torch.isfinite(loss)):
            raise NonFiniteError("loss", float(loss.detach()))
        self._accelerator.backward(loss)
        if self._grad_clip_norm > 0:
            clip = torch.nn.utils.clip_grad_norm_ if self._is_plain else self._accelerator.clip_grad_norm_
            norm = clip(self.policy.parameters(), self._grad_clip_norm)
        else:
            norm = torch.nn.utils.clip_grad_norm_(self.policy.parameters(), float("inf"))
        if self._checks_at_once and not bool(torch.isfinite(norm)):
            raise NonFiniteError("norm of the gradient", float(norm))
        self.optimizer.step()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        if self._update_buffers is not None:
            self._update_buffers()
        return StepResult(loss.detach(), norm.detach(), outputs or {})

    def held_out_loss(self, batches: Iterator[Batch], seed: int) -> float:
        """Return the mean loss over samples that are not learned from.

        Dropout is off, and what a policy draws, it draws from `seed`: the same in every evaluation, and the training
        continues as if there had been none.
        """
        device = self._accelerator.device
        total, count = torch.zeros((), dtype=torch.float64, device=device), 0
        self.policy.eval()
        try:
            with torch.random.fork_rng([device] if device.type == "cuda" else []), torch.no_grad():
                torch.manual_seed(seed)
                for raw in batches:
                    size = len(next(value for value in raw.values() if isinstance(value, Tensor)))
                    with nullcontext() if self._is_plain else self._accelerator.autocast():
                        loss, _ = self.policy.forward(self.prepare(raw))
                    total += loss.double() * size
                    count += size
        finally:
            self.policy.train()
        both = torch.stack([total, torch.tensor(float(count), dtype=torch.float64, device=device)])
        both = self._accelerator.reduce(both, reduction="sum")
        return float(both[0] / both[1])
