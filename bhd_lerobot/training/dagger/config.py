"""Configuration of dataset aggregation: which programs make a round, and how many rounds there are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options import parse as configuration
from bhd_lerobot.options.declared import Count, LibrarySeed, OneOf, Options, Whole
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.dagger.brain import DaggerConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.training.arguments import parse_train

ALGORITHM = "dagger"
FILES = "files.yaml"
"""What the files say that the configuration of a run names, in the run's folder."""
STAGES = ("expert", "learner", "policy", "evaluation")
"""The options of a run that name a program."""
OWN = frozenset(
    {
        *("dataset.root", "dataset.num_episodes", "dataset.push_to_hub", "dataset.expert_action", "brain.learner.path"),
        *("policy.push_to_hub", "selection.expert_action", "resume", "output_dir", "seed"),
        *("only", "baseline", "split", "n_episodes", "videos"),
        *("brains.expert", "brains.policy", "brains.policy.type", "brains.policy.path"),
    }
)
"""Options that the rounds set themselves."""


@dataclass
class StageConfig:
    """One of the programs that a round runs.

    Attributes:
        config: its configuration file.
        options: options of its command line, for example ``["--task.trail=true"]``.
    """

    config: str = ""
    options: list[str] = field(default_factory=list)


@dataclass
class AggregationConfig(Options):
    """Dataset aggregation (S. Ross, G. Gordon and D. Bagnell, "A reduction of imitation learning", AISTATS 2011).

    Round 0 learns from an expert that drives alone. In every further round the last policy drives, the expert takes
    over where the brain ``dagger`` lets it, and a new policy learns from everything that was recorded so far. Where
    `learner` records what the expert would have done in every frame, that is what is learned
    (`selection.expert_action`); otherwise what the expert did, in the frames that it drove
    (`selection.learner_weight` of 0).

    Attributes:
        algorithm: ``"dagger"``.
        expert: a configuration of `bhd-record`, whose brain is the expert.
        learner: a configuration of `bhd-record`, with the brain ``dagger``; its learner is the last policy.
        policy: a configuration of `bhd-train`.
        evaluation: a configuration of `bhd-eval`, whose robot and task are used for the curve over the rounds.
        data: folders of datasets that were recorded before, of the same robot and task; every round learns from them,
            too.
        output_dir: folder for all results; the same command continues there with the steps that are missing.
        rounds: number of rounds after the first.
        expert_episodes: number of episodes that the expert drives alone.
        episodes: number of episodes that the policy of the last round drives in each further round.
        validation_episodes: number of episodes of the split `validation` that evaluate each round's policy.
        seed: seed of the training and of the recordings; each round has its own episodes.
    """

    algorithm: Annotated[str, OneOf((ALGORITHM,))] = ALGORITHM
    expert: StageConfig = field(default_factory=StageConfig)
    learner: StageConfig = field(default_factory=StageConfig)
    policy: StageConfig = field(default_factory=StageConfig)
    evaluation: StageConfig = field(default_factory=StageConfig)
    data: list[str] = field(default_factory=list)
    output_dir: str = ""
    rounds: Whole = 2
    expert_episodes: Count = 400
    episodes: Count = 200
    validation_episodes: Count = 200
    seed: LibrarySeed = 0

    @property
    def stages(self) -> tuple[StageConfig, ...]:
        """The programs of a round, in their order, and before them the expert."""
        return tuple(getattr(self, name) for name in STAGES)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.output_dir:
            raise ConfigError("output_dir is empty; name the folder in which the rounds are kept: --output_dir=FOLDER.")
        for name in STAGES:
            if not getattr(self, name).config:
                raise ConfigError(f"{name}.config is empty; name a configuration file: --{name}.config=FILE.")


@dataclass(frozen=True)
class Stages:
    """What the configurations of the programs say."""

    expert: str
    brain: dict[str, Any]
    robot: str
    fps: int
    has_advice: bool
    steps: int


def read_stages(config: AggregationConfig) -> Stages:
    """Return what the configurations say, so that what is wrong in one of them is known before the first round."""
    expert = configuration.parse(RecordConfig, command(config.expert, {}))
    learner = configuration.parse(RecordConfig, command(config.learner, {}))
    kinds = [BrainConfig.get_choice_name(type(one.brain)) for one in (expert, learner)]
    if not isinstance(learner.brain, DaggerConfig):
        raise ConfigError(
            f"learner.config is {config.learner.config!r}, whose brain is {kinds[1]!r}; it must be 'dagger', in which "
            "a policy drives and an expert helps."
        )
    for stage, parsed in ((config.expert, expert), (config.learner, learner)):
        if parsed.split != "train":
            raise ConfigError(
                f"split is {parsed.split!r} in {stage.config!r}: its episodes are reserved for evaluation. Leave it "
                "out."
            )
    evaluation = configuration.parse(EvalConfig, command(config.evaluation, {}))
    for other, name in ((learner, "learner"), (evaluation, "evaluation")):
        _check_same(expert, other, f"{name}.config, {getattr(config, name).config!r}", config.expert.config)
    policy = parse_train(command(config.policy, {}))
    weight = "selection.learner_weight"
    if not learner.dataset.expert_action and weight in _names(config.policy):
        raise ConfigError(
            f"The option --{weight} of {config.policy.config!r} weighs frames in which {config.learner.config!r} does "
            "not record the expert's action (dataset.expert_action is false): they are not used for training. Leave "
            "it out of its options."
        )
    return Stages(
        expert=str(kinds[0]),
        brain=configuration.encode(expert)["brain"],
        robot=expert.robot.type,
        fps=expert.dataset.fps,
        has_advice=learner.dataset.expert_action,
        steps=policy.steps,
    )


def _check_same(expert: RecordConfig, other: RecordConfig | EvalConfig, who: str, expert_file: str) -> None:
    """Refuse a program that has another robot, frame rate or kind of task than the expert."""
    for name, theirs, ours in (
        ("robot.type", other.robot.type, expert.robot.type),
        ("the frame rate", other.robot.fps, expert.robot.fps),
        ("task.type", *(one.task.get_choice_name(type(one.task)) for one in (other, expert))),
    ):
        if theirs != ours:
            raise ConfigError(
                f"{name} is {theirs!r} in {who}, and {ours!r} in that of the expert, {expert_file!r}. A policy learns "
                "from both: make them equal, in the files or in their options."
            )


def command(stage: StageConfig, own: Mapping[str, Any]) -> list[str]:
    """Return the command line of a program: its file, what a round needs, and the options of the stage."""
    # The curve compares with the expert that teaches, not with one that another option changed.
    if taken := sorted(name for name in _names(stage) if name in OWN or name.startswith("brains.expert.")):
        raise ConfigError(
            f"The option --{taken[0]} of {stage.config!r} is set by the rounds themselves; leave it out of its options."
        )
    values = [f"--{name}={value}" for name, value in own.items()]
    return [f"--{configuration.CONFIG_PATH}={stage.config}", *values, *stage.options]


def _names(stage: StageConfig) -> set[str]:
    """Return the names of a stage's options."""
    return {option.removeprefix("--").partition("=")[0] for option in stage.options}


def parse_aggregation(arguments: Sequence[str] | configuration.CommandLine) -> AggregationConfig:
    """Return what a command line asks for."""
    line = configuration.read_line(arguments)
    config = configuration.parse(AggregationConfig, line)
    run = line.path.parent if line.path is not None and line.path.name == configuration.RUN_CONFIG else None
    if run is not None and "output_dir" not in line.options and (run / FILES).is_file():
        config.output_dir = str(run)  # it may have been moved
    return config


def kept(folder: Path) -> AggregationConfig | None:
    """Return the configuration that a folder's rounds were made with; None if there is none.

    An option that was not there yet when they were made has its default.
    """
    file = folder / configuration.RUN_CONFIG
    if not file.is_file():
        return None
    return parse_aggregation([f"--{configuration.CONFIG_PATH}={file}"])
