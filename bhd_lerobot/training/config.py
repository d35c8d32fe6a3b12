"""Configuration of `bhd-train`: LeRobot's, and a few fields of ours."""

import copy
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK

from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.datasets.loader.selection import HOLD_OUTS, EpisodeFilter
from bhd_lerobot.errors import ConfigError, quoted
from bhd_lerobot.options.declared import (
    Count,
    LibrarySeed,
    NotNegative,
    OneOf,
    Options,
    Range,
    Share,
    check_option,
    check_options,
)
from bhd_lerobot.options.parse import encode

OWN_CONFIG_NAME = "bhd_train.json"
"""The fields that LeRobot's `train_config.json` has no place for; beside it in every checkpoint."""


@dataclass
class SelectionConfig(Options, prefix="selection."):
    """Selection of the frames to train on.

    Attributes:
        outcome: episodes with these outcomes: `all`, or events that an episode can end with, such as `success`.
        min_score: episodes with at least this score, 0 to 1; by default any.
        exclude_late: leave out episodes with more late frames than their recording tolerated.
        intervention_weight: sampling weight of frames in which someone intervened, relative to others; 0 drops them:
            chunks of actions end before them, as they do at an episode's end.
        learner_weight: sampling weight of frames that a learner drove while someone could have intervened, relative to
            others; 0 drops them likewise, so that only the expert's own driving is learned.
        expert_action: learn the expert's action of every frame, `expert.action`, instead of the executed one.
        hold_out: unit of `dataset.eval_split`: `episode`, a share of all episodes; `instruction`, a share of each
            instruction's episodes, at least one of each, as `lerobot-train` does.
    """

    outcome: list[str] = field(default_factory=lambda: ["all"])
    min_score: Share | None = None
    exclude_late: bool = False
    intervention_weight: NotNegative = 1.0
    learner_weight: NotNegative = 1.0
    expert_action: bool = False
    hold_out: Annotated[str, OneOf(HOLD_OUTS)] = "episode"

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.filter

    @property
    def filter(self) -> EpisodeFilter:
        """Which episodes are wanted."""
        return EpisodeFilter(outcome=self.outcome, min_score=self.min_score, exclude_late=self.exclude_late)

    @property
    def is_everything(self) -> bool:
        """Whether no episode is left out."""
        return self.filter.outcomes is None and self.min_score is None and not self.exclude_late


@dataclass
class BhdTrainConfig(TrainPipelineConfig):
    """Train a policy on a LeRobotDataset, with a loop that resumes to the same bits.

    All fields of LeRobot's `TrainPipelineConfig` mean what they mean for `lerobot-train`. One default differs:
    `policy.push_to_hub` is true only if it was set.

    Attributes:
        selection: the frames to train on.
        budget_gib: memory for the dataset as tensors [GiB]; a larger dataset is read by LeRobot's own loader.
        fine_tune: checkpoint to start from: a folder, or a name on the Hub. Like `policy.path`, but the dataset is
            checked against the checkpoint's training data.
        fine_tune_statistics: with `fine_tune`, the statistics that normalise observations and actions: those of the
            `checkpoint`, which keep the meaning of its weights, or those of the `dataset`.
        fine_tune_parameters: the policy's parameters that are trained, by name or pattern; the others are not
            changed. `["*.bias"]` changes so little that a few episodes suffice for a shift (E. Ben Zaken et al.,
            "BitFit", 2022).
        fine_tune_camera: with `fine_tune` of a policy that models its camera's pose, first estimate the present pose
            from the dataset.
        threads: threads of a training process on the CPU; by default PyTorch's number. The last bits of a loss
            depend on it.
    """

    selection: SelectionConfig = field(default_factory=SelectionConfig)
    budget_gib: Annotated[float, Range("(0, inf]")] = 4.0
    fine_tune: str | None = None
    fine_tune_statistics: Annotated[str, OneOf(("checkpoint", "dataset"))] = "checkpoint"
    fine_tune_parameters: list[str] = field(default_factory=lambda: ["*"])
    fine_tune_camera: bool = False
    threads: Count | None = None
    started_from = cast("str | Path | None", None)  # not an option: `policy.pretrained_path` of a run that is resumed

    def _resolve_pretrained_from_cli(self) -> None:
        """Do nothing: `arguments.parse_train` has done it, and from its own arguments."""

    def validate(self) -> None:
        """Check the configuration and fill in what follows from it: LeRobot's rules, and ours.

        Raises:
            ConfigError: names the value, and what would be valid.
        """
        check_options(self)
        check_option("seed", self.seed, LibrarySeed)
        for name, value, least in (
            ("steps", self.steps, 1),
            ("log_freq", self.log_freq, 0),
            ("save_freq", self.save_freq, 0),
            ("eval_steps", self.eval_steps, 0),
            ("env_eval_freq", self.env_eval_freq, 0),
            ("eval.n_episodes", self.eval.n_episodes if self._is_evaluated else 1, 1),
            ("eval.batch_size", self.eval.batch_size if self._is_evaluated else 1, 1),
        ):
            if value < least:
                raise ConfigError(f"{name} is {value}; it must be at least {least}.")
        self.loader_config()
        if self.fine_tune_camera and not (self.fine_tune or self.resume):
            raise ConfigError("fine_tune_camera is true, but no checkpoint is given; set --fine_tune.")
        if self.policy is None:
            raise ConfigError(
                f"No policy is given; set --policy.type, one of {', '.join(policy_types())}, or --fine_tune."
            )
        if self.reward_model is not None:
            raise ConfigError("bhd-train trains policies; for a reward_model use lerobot-train.")
        if self.dataset.streaming or self.job.is_remote:
            option = "dataset.streaming" if self.dataset.streaming else "job.target"
            raise ConfigError(f"{option} is not for bhd-train; use lerobot-train, which reads the same configuration.")
        if self.output_dir is not None and not self.resume:
            refuse_existing(Path(self.output_dir))
        if self.policy.push_to_hub and not self.policy.repo_id:
            raise ConfigError("policy.push_to_hub is true: set --policy.repo_id=user/name, or push_to_hub to false.")
        given = self.optimizer, self.scheduler
        try:
            super().validate()
        except (ValueError, OSError, NotImplementedError) as error:
            raise ConfigError(f"The configuration cannot be used: {error}") from error
        if self.use_policy_training_preset and not self.resume:
            self._refuse_unused(*given)

    def loader_config(self, **fields: Any) -> LoaderConfig:
        """Return how the dataset is loaded.

        Args:
            fields: of `LoaderConfig`, those that the policy and the machine decide.

        Raises:
            ConfigError: a value out of range.
        """
        return LoaderConfig(
            batch_size=self.batch_size,
            seed=0 if self.seed is None else self.seed,
            episodes=self.dataset.episodes,
            intervention_weight=self.selection.intervention_weight,
            learner_weight=self.selection.learner_weight,
            expert_action=self.selection.expert_action,
            eval_split=self.dataset.eval_split,
            hold_out=self.selection.hold_out,
            max_eval_samples=self.max_eval_samples,
            use_imagenet_stats=self.dataset.use_imagenet_stats,
            tolerance_s=self.tolerance_s,
            video_backend=self.dataset.video_backend,
            depth_output_unit=self.dataset.depth_output_unit,
            budget_gib=self.budget_gib,
            num_workers=self.num_workers,
            prefetch_factor=self.prefetch_factor,
            persistent_workers=self.persistent_workers,
            **fields,
        )

    @property
    def _is_evaluated(self) -> bool:
        return self.env is not None and self.env_eval_freq > 0

    def _refuse_unused(self, optimizer: Any, scheduler: Any) -> None:
        """Refuse an optimizer or scheduler that LeRobot would silently replace by the policy's own."""
        for name, wanted, used in (("optimizer", optimizer, self.optimizer), ("scheduler", scheduler, self.scheduler)):
            if wanted is not None and wanted != used:
                raise ConfigError(
                    f"{name} is given, but use_policy_training_preset is true, which takes the policy's own. Set "
                    f"it to false and both optimizer and scheduler, or change policy.{name}_… instead."
                )

    def plain(self) -> dict[str, Any]:
        """Return plain values that make the same run again: of one that is resumed those that it was started with."""
        values = encode(self)
        if self.resume:
            values |= {"resume": False, "checkpoint_path": None}
            values["policy"]["pretrained_path"] = None if self.started_from is None else str(self.started_from)
        return values

    def _save_pretrained(self, save_directory: Path) -> None:
        """Write LeRobot's fields into the file that LeRobot reads, and ours beside it."""
        values = self.plain()
        own = {name: values.pop(name) for name in own_fields()}
        (save_directory / TRAIN_CONFIG_NAME).write_text(json.dumps(values, indent=4), encoding="utf-8")
        (save_directory / OWN_CONFIG_NAME).write_text(json.dumps(own, indent=4), encoding="utf-8")


def refuse_existing(folder: Path) -> None:
    """Refuse a run's folder that is there already, with how to continue a run in it."""
    try:
        if not folder.exists():
            return
        has_run = (folder / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK).is_dir()
    except OSError as error:  # a name that is too long, a folder that may not be looked into
        raise ConfigError(f"The output folder {folder} cannot be used: {error.strerror}. Set --output_dir.") from error
    resume = f", or continue its run with --resume=true --config_path={quoted(folder)}" if has_run else ""
    raise ConfigError(
        f"The output folder {folder} exists{'' if has_run else ' and holds no run to continue'}. Set another "
        f"--output_dir{resume}."
    )


def own_fields() -> list[str]:
    """Return the names of the fields that LeRobot's configuration does not have."""
    stock = {one.name for one in dataclasses.fields(TrainPipelineConfig)}
    return [one.name for one in dataclasses.fields(BhdTrainConfig) if one.name not in stock]


def policy_types() -> Sequence[str]:
    """Return the policies that can be trained, by the name of their type."""
    return sorted(PreTrainedConfig.get_known_choices())


def without_places(value: Any) -> Any:
    """Return a copy of a configuration that can be published: of absolute paths only their names are left."""
    if isinstance(value, Path | str):
        path = Path(value).expanduser()
        return type(value)(path.name) if path.is_absolute() else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        one = copy.copy(value)
        for name, part in vars(value).items():
            object.__setattr__(one, name, without_places(part))
        return one
    if isinstance(value, dict):
        return {key: without_places(part) for key, part in value.items()}
    return type(value)(map(without_places, value)) if type(value) in (list, tuple) else value
