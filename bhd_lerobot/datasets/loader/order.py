"""In which order a training sees the samples: a pure function of seed and epoch, the same on every rank."""

import math
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from bhd_lerobot.errors import ConfigError

T = TypeVar("T")


class BatchOrder:
    """Batches of sample indices, epoch by epoch, with the state that a resumed training needs.

    Without weights, an epoch is the permutation that LeRobot's `EpisodeAwareSampler` draws for the same seed and epoch.
    With weights, samples are drawn with replacement, as many as have a positive weight; if all positive weights are
    equal, the others are left out and the rest is permuted. Batches go to the ranks in turns, as accelerate deals
    them, and with several ranks the last ones are filled from the beginning of the epoch, so that all ranks have
    equally many of the same size.

    Starting a new iteration while one is under way continues with the next epoch.
    """

    def __init__(
        self,
        samples: Tensor,
        batch_size: int,
        seed: int,
        *,
        shuffle: bool = True,
        drop_last: bool = False,
        weights: Tensor | None = None,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        """Check that there is something to draw.

        Args:
            samples: indices to draw from, shape (M,), int64.
            weights: relative frequency of each of `samples`, shape (M,), not negative; needs `shuffle`.
        """
        self.batch_size, self.seed, self.shuffle, self.drop_last = batch_size, seed, shuffle, drop_last
        self.rank, self.world_size = rank, world_size
        self._cumulated: Tensor | None = None
        if weights is not None:
            samples = self._weigh(samples, weights)
        if not len(samples):
            raise ConfigError("No sample is left to draw from: all were filtered out, or all weights are 0.")
        if drop_last and len(samples) < batch_size * world_size:
            raise ConfigError(
                f"drop_last leaves no batch: {len(samples)} samples are fewer than batch_size {batch_size} x "
                f"{world_size} ranks. Use a smaller batch_size."
            )
        self.samples = samples
        self._epoch = self._position = 0
        self._running = False

    def _weigh(self, samples: Tensor, weights: Tensor) -> Tensor:
        if weights.shape != samples.shape:
            raise ConfigError(f"{tuple(weights.shape)} weights for {tuple(samples.shape)} samples.")
        if not bool(torch.isfinite(weights).all()) or bool((weights < 0).any()):
            raise ConfigError("Weights of samples must be finite and not negative.")
        if not self.shuffle:
            raise ConfigError("Weights need shuffle=True: they say how often a sample is drawn.")
        used = weights > 0
        samples, weights = samples[used], weights[used].double()
        if len(weights) and float(weights.min()) != float(weights.max()):
            self._cumulated = torch.cumsum(weights, 0)
        return samples

    def __len__(self) -> int:
        everyone = self.batch_size * self.world_size
        return len(self.samples) // everyone if self.drop_last else math.ceil(len(self.samples) / everyone)

    def __iter__(self) -> Iterator[Tensor]:
        """Return the batches of the epoch, shape (B,) each; the last one may be smaller."""
        return self.follow(iter)

    def follow(self, fetch: Callable[[Iterator[Tensor]], Iterator[T]]) -> Iterator[T]:
        """Return what `fetch` makes of the batches of the epoch; the state counts what came out, not what went in."""
        if self._running:
            self._epoch, self._position = self._epoch + 1, 0
        self._running = True
        return self._follow(self._epoch, self._position, fetch)

    def state_dict(self) -> dict[str, Any]:
        """Return where the order is: `epoch`, and `position`, the samples of that epoch that all ranks have had."""
        return {"epoch": self._epoch, "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state_dict` returned; the next iteration starts there."""
        epoch, position = int(state["epoch"]), int(state["position"])
        if epoch < 0 or not 0 <= position <= len(self.samples):
            raise ConfigError(
                f"The order of samples cannot continue at epoch {epoch}, position {position}: an epoch has "
                f"{len(self.samples)} samples. The state is of another dataset or selection."
            )
        left = len(self.samples) - position
        if left <= 0 or (self.drop_last and left < self.batch_size * self.world_size):
            epoch, position = epoch + 1, 0
        self._epoch, self._position, self._running = epoch, position, False

    def seek(self, batches: int) -> None:
        """Go to where the order is after so many batches of this rank."""
        epoch, done = divmod(batches, len(self))
        self.load_state_dict({"epoch": epoch, "position": done * self.batch_size * self.world_size})

    def epoch_order(self, epoch: int) -> Tensor:
        """Return the samples of an epoch, of all ranks, in order."""
        if not self.shuffle:
            return self.samples
        # LeRobot's derivation, so that the same seed gives the same batches as stock lerobot-train.
        derived = np.random.SeedSequence([self.seed, epoch]).generate_state(1, dtype=np.uint64)[0]
        generator = torch.Generator().manual_seed(int(derived))
        count = len(self.samples)
        if self._cumulated is None:
            return self.samples[torch.randperm(count, generator=generator)]
        draws = torch.rand(count, generator=generator, dtype=torch.float64) * self._cumulated[-1]
        return self.samples[torch.searchsorted(self._cumulated, draws, right=True).clamp_(max=count - 1)]

    def _follow(self, epoch: int, position: int, fetch: Callable[[Iterator[Tensor]], Iterator[T]]) -> Iterator[T]:
        count = len(self.samples)
        for result in fetch(self._batches(epoch, position)):
            position += self.batch_size * self.world_size
            if self._running and self._epoch == epoch:
                self._position = min(position, count)
            yield result
        if self._running and self._epoch == epoch:
            self._epoch, self._position, self._running = epoch + 1, 0, False

    def _batches(self, epoch: int, position: int) -> Iterator[Tensor]:
        order = self.epoch_order(epoch)
        size, everyone, count = self.batch_size, self.batch_size * self.world_size, len(order)
        while position < count and not (self.drop_last and position + everyone > count):
            begin = position + self.rank * size
            position += everyone
            if self.world_size == 1 or position <= count:
                yield order[begin : begin + size]
            else:
                yield order[torch.arange(begin, begin + size) % count]
