"""What happens before and after `bhd_mlp`, in LeRobot's own steps and ours."""

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.mlp.objects_mlp import ObjectOrderProcessorStep
from bhd_lerobot.policies.mlp.scan_mlp import ScanProcessorStep
from bhd_lerobot.policies.mlp.target_mlp import TargetProcessorStep
from bhd_lerobot.policies.mlp.yaw_mlp import YawProcessorStep
from bhd_lerobot.policies.trained_steps import Pipelines, Stats, TrainedStep, make_pipelines


def make_bhd_mlp_pre_post_processors(config: MlpConfig, dataset_stats: Stats | None = None) -> Pipelines:
    """Return the pipelines that normalise observations and give actions their units back."""
    own: list[TrainedStep] = []
    if config.scan.is_used and config.scan.transform != "none":
        if config.scan.start is None:
            raise ConfigError("policy.scan.start is not known yet; make the policy before its processors.")
        own.append(ScanProcessorStep(start=config.scan.start, beams=config.scan.beams))
    if config.sort_objects:
        if not config.objects:
            raise ConfigError("The objects' columns are not known yet; make the policy before its processors.")
        start, count, size, *fields = config.objects
        own.append(ObjectOrderProcessorStep(start, count, size, tuple(fields), tuple(config.tool_columns)))
    if config.relative_target:
        if not config.target_columns:
            raise ConfigError("The target's columns are not known yet; make the policy before its processors.")
        own.append(TargetProcessorStep(tuple(config.tool_columns), tuple(config.target_columns)))
    if config.yaw_harmonics:
        if not config.quaternions:
            raise ConfigError("The quaternions' columns are not known yet; make the policy before its processors.")
        own.append(YawProcessorStep(config.state_quaternions, config.environment_quaternions))
    return make_pipelines(config, dataset_stats, *own)
