"""Configuration of the brain `topic`."""

from dataclasses import dataclass, field

from bhd_lerobot.options.declared import Positive
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.ros2.live.network import NetworkConfig


@BrainConfig.register_subclass("topic")
@dataclass
class TopicConfig(BrainConfig):
    """Another node drives: the setpoints are the newest messages of ROS 2 topics.

    Attributes:
        mapping: YAML file whose section `action` says which field of which topic is which action, see "Use ROS 2".
            Without it a base is driven by ``/brain/cmd_vel``, TwistStamped, or Twist with `network.distro` humble, and
            joints by the values of ``/brain/commands``, a Float64MultiArray in the order of the other actions.
        network: where the node is.
        command_timeout_s: a message that is older gives no setpoint; the robot then stops by its own time-out [s].
        timeout_s: without a message for so long the episode ends with a fault [s].
    """

    mapping: str = ""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    command_timeout_s: Positive = 0.5
    timeout_s: Positive = 10.0
