"""The brain `dagger`: a learner drives, and an expert takes over where the learner needs help.

What the expert does is recorded as an intervention, and a policy that learns from it has seen what to do in the states
that it gets itself into: DAgger (S. Ross, G. Gordon and D. Bagnell, AISTATS 2011) in the form of HG-DAgger (M. Kelly,
C. Sidrane, K. Driggs-Campbell and M. Kochenderfer, ICRA 2019), with a rule in the place of the human.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ActionError, ConfigError
from bhd_lerobot.options.declared import Positive
from bhd_lerobot.policies.brain import (
    Brain,
    BrainConfig,
    DriverConfig,
    Observation,
    RobotFeatures,
)
from bhd_lerobot.policies.dagger.takeover import DisagreementWatch, PatienceWatch, StallWatch, Watch, collision_watch
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain

Array = NDArray[np.float64]
LEARNER_DRIVES = "the learner drives"
_EXPERT_STREAM = 3  # the expert's random numbers are not the learner's


@BrainConfig.register_subclass("dagger")
@dataclass
class DaggerConfig(BrainConfig):
    """A learner, an expert, and when the expert takes over: one reason is enough, what is left out is not watched.

    Attributes:
        learner: what drives; it gives setpoints. Normally `learned`.
        expert: what takes over: a rule that gives setpoints.
        collision_s: the learner is about to collide: a base within this time [s], with what its lidar sees; an arm, if
            it could not come to rest any more, with the table or with itself.
        stall_s: the robot has got nowhere for so long [s].
        disagreement: the learner's action is farther from the expert's than this share of its range.
        disagreement_s: it has been so for so long [s].
        patience_s: the learner has driven for so long [s].
        hold_s: how long the expert drives before the learner has another turn [s]; to the episode's end if not set.
    """

    is_composed: ClassVar[bool] = True

    learner: DriverConfig
    expert: DriverConfig
    collision_s: Positive | None = 0.5
    stall_s: Positive | None = 3.0
    disagreement: Positive | None = None
    disagreement_s: Positive = 0.5
    patience_s: Positive | None = None
    hold_s: Positive | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("learner", "expert"):
            if isinstance(getattr(self, name), DaggerConfig):
                raise ConfigError(f"brain.{name}.type is 'dagger' itself; choose a brain that drives.")
        if getattr(self.learner, "stream", False):
            raise ConfigError(
                "brain.learner.stream is true, but the driver is chosen anew in every frame. Set it to false."
            )


class DaggerBrain(Brain):
    """Drives with a learner, and with an expert where the learner needs help.

    The learner acts in every frame of its turns, and between them if it gets another; the expert acts in every frame,
    so that it knows where the robot has been.
    """

    name = "dagger"

    def __init__(self, config: DaggerConfig, learner: Brain, expert: Brain) -> None:
        super().__init__(config)
        check_drivers(type(learner), type(expert))
        self.learner, self.expert = learner, expert
        self.has_plan = expert.has_plan
        self.uses_images = learner.uses_images or expert.uses_images
        self.uses_privileged_state = learner.uses_privileged_state or expert.uses_privileged_state
        self._advised: Array = np.zeros((0, 0))
        self._watches: list[Watch] = []
        self._collision: Watch | None = None
        self._hold: int | None = None
        self._width = 0
        self._driving: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._driven = np.zeros(0, np.int64)
        self._causes: list[str] = []
        self._shown: NDArray[np.bool_] = np.zeros(0, np.bool_)

    def bind(self, robot: RobotFeatures) -> None:
        """Bind learner and expert, and find what is to be watched."""
        config = self.config
        self.learner.bind(robot)
        self.expert.bind(robot)
        self._width = len(robot.action_names)

        def frames(time_s: float) -> int:
            return max(1, round(time_s * robot.fps))

        self._hold = None if config.hold_s is None else frames(config.hold_s)
        self._watches, self._collision = [], None
        if config.collision_s is not None:
            self._collision = collision_watch(config.collision_s, robot)
            self._watches.append(self._collision)
        if config.disagreement is not None:
            watch = DisagreementWatch(config.disagreement, frames(config.disagreement_s), robot)
            self._watches.append(watch)
        if config.stall_s is not None:
            self._watches.append(StallWatch(frames(config.stall_s), robot))
        if config.patience_s is not None:
            self._watches.append(PatienceWatch(frames(config.patience_s)))

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes: the learner has the first turn."""
        if len(self._driving) != n:
            self._driving, self._shown = np.zeros((2, n), np.bool_)
            self._driven, self._causes = np.zeros(n, np.int64), [""] * n
            self._advised = np.full((n, self._width), np.nan)
        self._driving[ids] = self._shown[ids] = False
        self._driven[ids] = 0
        for sim in ids.tolist():
            self._causes[sim] = ""
        for watch in self._watches:
            watch.restart(ids, n)
        # The learner's numbers are those that it would have alone.
        self.learner.reset(ids, seeds, n, instructions)
        own = [int(np.random.SeedSequence([_EXPERT_STREAM, seed]).generate_state(1)[0]) for seed in seeds]
        self.expert.reset(ids, own, n, instructions)

    def act(self, observation: Observation) -> Array:
        """Return what the robots are to do, shape (n, actions)."""
        running = np.ones(len(self._driving), np.bool_) if observation.running is None else observation.running
        wanted = self._ask_learner(observation, running)
        self._advised = advised = _setpoints(self.expert.act(observation), self.expert.name, "expert")
        self._decide(observation, wanted, advised, running)
        self._shown = self._driving & running
        return np.where(self._driving[:, None], advised, wanted)

    def advice(self) -> Array:
        """Return what the expert would do in the frame that `act` decided last, shape (n, actions), whatever drives."""
        return self._advised

    def interventions(self) -> NDArray[np.bool_]:
        """Return which robots the expert drives, shape (n,)."""
        return self._shown.copy()

    def causes(self) -> Sequence[str]:
        """Return why the expert took over last, of each simulation."""
        return tuple(self._causes)

    def subtasks(self) -> Sequence[str]:
        """Return what the expert is doing, as text, where it drives."""
        pairs = zip(self.expert.subtasks(), self._shown, strict=True)
        return [text if taken else LEARNER_DRIVES for text, taken in pairs]

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the expert's plan for one simulation."""
        return self.expert.plan(sim)

    def close(self) -> None:
        """Close learner and expert."""
        self.learner.close()
        self.expert.close()

    def parameters(self) -> dict[str, Any]:
        """Return the parameters, with those of learner and expert: which weights, for example."""
        own = {field.name: getattr(self.config, field.name) for field in fields(self.config)}
        return {
            "type": self.name,
            **own,
            "learner": self.learner.parameters(),
            "expert": self.expert.parameters(),
        }

    # --- turns -------------------------------------------------------------------------------------------------------

    def _ask_learner(self, observation: Observation, running: NDArray[np.bool_]) -> Array:
        """Return what the learner wants, shape (n, actions); zeros where it has no further turn."""
        needed = running if self._hold is not None else running & ~self._driving
        if not needed.any():
            return np.zeros((len(running), self._width))
        wanted = _setpoints(self.learner.act(replace(observation, running=needed)), self.learner.name, "learner")
        return np.where(needed[:, None], wanted, 0.0)

    def _decide(self, observation: Observation, wanted: Array, advised: Array, running: NDArray[np.bool_]) -> None:
        """Settle who drives in this frame."""
        n = len(running)
        self._driven += self._driving
        danger: NDArray[np.bool_] = np.zeros(n, np.bool_)
        if self._collision is not None:
            danger = self._collision.check(observation, wanted, advised)
        if self._hold is not None:
            # One who is about to collide would be taken over from again at once.
            over = self._driving & running & (self._driven >= self._hold) & ~danger
            if over.any():
                self._driving &= ~over
                for watch in self._watches:
                    watch.restart(np.flatnonzero(over), n)
        for watch in self._watches:
            mask = danger if watch is self._collision else watch.check(observation, wanted, advised)
            for sim in np.flatnonzero(mask & running & ~self._driving).tolist():
                self._driving[sim], self._driven[sim], self._causes[sim] = True, 0, watch.cause


def check_drivers(learner: type, expert: type) -> None:
    """Refuse a learner or an expert whose class gives goals."""
    for who, brain in (("learner", learner), ("expert", expert)):
        if issubclass(brain, GoalBrain):
            raise ConfigError(
                f"brain.{who}.type is {brain.name!r}, which gives goals; learner and expert give setpoints in every "
                "frame. In place of pick or language use pick_servo, and in place of reach use reach_servo, with "
                "--robot.action_space=tool --robot.tool_pose=true."
            )


def _setpoints(decision: Any, name: str, who: str) -> Array:
    if not isinstance(decision, np.ndarray):
        raise ActionError(
            f"brain.{who} is {name!r}, which gave {type(decision).__name__} instead of setpoints for this frame."
        )
    return decision
