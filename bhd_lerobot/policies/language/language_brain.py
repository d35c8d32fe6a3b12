"""The brain that does what an instruction says: language to a plan of skills, skills to goals."""

from collections.abc import Sequence
from dataclasses import dataclass

from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.language.instruction import RulePlanner
from bhd_lerobot.policies.manipulation.grasp import SeenObject
from bhd_lerobot.policies.manipulation.pick import PickBrain, PickBrainConfig, _Work
from bhd_lerobot.policies.manipulation.skills import Plan, Planner, scene_object


@BrainConfig.register_subclass("language")
@dataclass
class LanguageBrainConfig(PickBrainConfig):
    """Parameters of the language brain.

    Attributes:
        instruction: what to do, in English or Chinese; the task's instruction if empty.
    """

    instruction: str = ""


class LanguageBrain(PickBrain):
    """Finds the object that an instruction means by its name and its place, and carries the instruction out.

    It does not use which object the task marks. An instruction that it does not understand, or that fits no object
    or several, is not carried out: its subtask says why.

    Args:
        config: the parameters.
        planner: what turns instructions into plans; the rules if None. A language model goes here.
    """

    name = "language"

    def __init__(self, config: LanguageBrainConfig | None = None, planner: Planner | None = None) -> None:
        super().__init__(config or LanguageBrainConfig())
        self._planner = planner or RulePlanner()

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Take the instruction of the episode, or that of the configuration."""
        config = self.config
        own = config.instruction if isinstance(config, LanguageBrainConfig) else ""
        super().begin_episode(sim, seed, own or instruction)

    def _make_plan(self, work: _Work, objects: Sequence[SeenObject]) -> Plan:
        return self._planner.plan(work.instruction, [scene_object(item) for item in objects])
