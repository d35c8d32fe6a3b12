"""What happens before and after `bhd_perception`: nothing is normalised, its image is taken as it is."""

from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.policies.trained_steps import Pipelines, Stats, make_pipelines


def make_bhd_perception_pre_post_processors(config: PerceptionConfig, dataset_stats: Stats | None = None) -> Pipelines:
    """Return LeRobot's pipelines with the mapping to nothing."""
    return make_pipelines(config, dataset_stats)
