"""What a training reads of a dataset, and in which form: the configuration of `make_loader`."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.selection import HOLD_OUTS, EpisodeFilter
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.declared import Count, NotNegative, OneOf, Options, Positive, Range, Whole


@dataclass(frozen=True, kw_only=True)
class LoaderConfig(Options):
    """Which samples a training reads, in which order and form, and where batches are put.

    Attributes:
        batch_size: samples in a batch of this rank.
        seed: decides the order, with the number of the epoch; for the same seed it is that of `lerobot-train`.
        episodes: indices of the episodes to choose from; None means all.
        selection: which of these episodes; None means all.
        intervention_weight: how often frames with an intervention are drawn, compared with others; 0 drops them, and
            windows that look ahead end before them, as at an episode's end.
        learner_weight: how often frames are drawn in which nobody intervened though someone could have: those that a
            learner drove; 0 drops them likewise.
            Held-out samples are not weighted.
        expert_action: serve what the expert would have done, `expert.action`, as `action`.
        eval_split: share of the episodes that is held out, from 0 to below 1.
        hold_out: what `eval_split` is a share of: `episode` or `instruction`; see `split_episodes`.
        max_eval_samples: at most about this many held-out samples, the first of each task; 0 means all.
        delta_timestamps: key -> times relative to the sample [s], multiples of 1 / fps.
        drop_n_last_frames: frames at the end of each episode that no training sample starts from.
        image_transforms: applied to training images only.
        use_imagenet_stats: normalise images with the statistics of ImageNet.
        return_uint8: serve videos as uint8, which `lerobot-train` divides by 255 afterwards, instead of float32.
        tolerance_s: by how much a video frame may miss its time [s].
        video_backend: LeRobot's decoder whose pixels are served.
        depth_output_unit: in which unit LeRobot's dataset serves what depth cameras measure: `mm` or `m`.
        keep: features to serve besides the index columns; None serves all. LeRobot's dataset always serves all.
        budget_gib: memory that columns and decoded images may take [GiB].
        num_workers: processes of PyTorch's `DataLoader`, where LeRobot's dataset is used.
        prefetch_factor: batches that each of them prepares.
        persistent_workers: keep them between epochs.
        drop_last: leave an incomplete batch out of the training's epochs.
        device: where batches are put, through page-locked memory if it is a GPU; None leaves them in memory.
        rank: this process among `world_size`.
        world_size: processes that train together.

    Raises:
        ConfigError: an unknown field, or a value out of range; the message names the valid ones.
    """

    batch_size: Count
    seed: Whole = 0
    episodes: Sequence[int] | None = None
    selection: EpisodeFilter | None = None
    intervention_weight: NotNegative = 1.0
    learner_weight: NotNegative = 1.0
    expert_action: bool = False
    eval_split: Annotated[float, Range("[0, 1)")] = 0.0
    hold_out: Annotated[str, OneOf(HOLD_OUTS)] = "episode"
    max_eval_samples: Whole = 0
    delta_timestamps: Mapping[str, Sequence[float]] | None = None
    drop_n_last_frames: Whole = 0
    image_transforms: Callable[[Tensor], Tensor] | None = None
    use_imagenet_stats: bool = True
    return_uint8: bool = True
    tolerance_s: Positive = 1e-4
    video_backend: str | None = "pyav"
    depth_output_unit: Annotated[str, OneOf(("mm", "m"))] = "mm"
    keep: Collection[str] | None = None
    budget_gib: Annotated[float, Range("(0, inf]")] = 4.0
    num_workers: Whole = 0
    prefetch_factor: Count = 4
    persistent_workers: bool = True
    drop_last: bool = False
    device: torch.device | str | None = None
    rank: Whole = 0
    world_size: Count = 1

    def __new__(cls, **fields: Any) -> Self:
        """Refuse a field that does not exist."""
        names = [field.name for field in dataclasses.fields(cls)]
        for name in fields:
            if name not in names:
                raise ConfigError(unknown_name("field of LoaderConfig", name, names))
        return super().__new__(cls)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rank >= self.world_size:
            raise ConfigError(f"rank is {self.rank}; it must be from 0 to world_size - 1 = {self.world_size - 1}.")
