"""Bring the tool to a pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive, Share
from bhd_lerobot.tasks.sensing import Sensing, SensingConfig
from bhd_lerobot.tasks.task import ArmTask, Event, Outcome, TaskConfig
from bhd_lerobot.tasks.variation import RandomisationConfig, draw_variation

# A target is reached in a posture at least this many times better than one that counts as singular: a brain that comes
# to the pose by another branch of the inverse kinematics shall find it reachable, too.
_AWAY_FROM_SINGULAR = 3.0
_TRIES = 10_000

ENVIRONMENT = tuple(f"target_{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))


@TaskConfig.register_subclass("reach")
@dataclass
class ReachConfig(TaskConfig):
    """What the reach task asks for.

    Attributes:
        duration_s: longest duration of an episode [s].
        tolerance_m: distance of the tool from the target that counts as reached [m].
        tolerance_deg: angle between the tool's and the target's orientation that counts as reached [deg].
        hold_s: time that the tool must stay there [s].
        start_spread_rad: every joint starts at home plus or minus up to this [rad].
        randomisation: how much one episode's world differs from the next.
        sensing: what is wrong with what the task senses of the target.
    """

    duration_s: Positive = 10.0
    tolerance_m: Positive = 0.005
    tolerance_deg: Positive = 2.0
    hold_s: Positive = 0.25
    start_spread_rad: Share = 0.3
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
    sensing: SensingConfig = field(default_factory=SensingConfig)


class ReachTask(ArmTask):
    """The reach task for n simulations.

    Success: the tool within the tolerances of the target for `hold_s`. Failures: `collision` (the arm touches the table
    or itself) and `timeout`. Score: the share of the way to the target that was covered in the end, 1 for a success.
    The reward of a frame is by how much the distance to the target fell, as a share of the distance at the start.
    """

    name = "reach"
    never = (Event.WRONG_OBJECT, Event.DROPPED, Event.STUCK)
    environment_names = ENVIRONMENT
    judged_by: frozenset[str] | None = frozenset({"tool_pose"})

    def __init__(self, config: ReachConfig, n: int, fps: int, body: Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self._hold = self.in_frames(config.hold_s)
        self._target = np.zeros((n, 7))
        self._camera_error = np.zeros((n, 3))
        self._sensing = Sensing(config.sensing, n, fps, slice(3))
        self._first, self._last = np.ones(n), np.ones(n)
        self._angle = np.zeros(n)
        self._within = np.zeros(n, np.int64)
        self._started = np.zeros(n, np.bool_)

    def sample(self, seed: int) -> TableScene:
        """Return the start posture and the target of the episode with this seed."""
        rng = np.random.default_rng(seed)
        return TableScene(
            name="reach",
            objects=(),
            posture=(*self._draw_start(rng), *self.arm.home[len(self.arm.chain.joints) :]),
            target_pose=self._draw_target(rng),
            instruction=self.instruction(None),
            variation=draw_variation(self.config.randomisation, rng),
            report_seed=self.config.sensing.draw_seed(rng),
        )

    def instruction(self, scene: TableScene | None) -> str:
        """Return what a person would ask for."""
        return "Bring the tool to the target pose."

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[TableScene]) -> None:
        """Start episodes in some simulations."""
        super().begin(ids, scenes)
        for sim, scene in zip(ids, scenes, strict=True):
            if scene.target_pose is None:
                raise ConfigError(f"The scene {scene.name!r} has no target pose to reach.")
            self._target[sim] = scene.target_pose
            self._camera_error[sim] = scene.variation.camera_error
            self._sensing.begin(sim, scene.report_seed)
        self._within[ids] = 0
        self._started[ids] = False

    def environment_state(self, truth: ArmTruth) -> NDArray[np.float64]:
        """Return the targets in the base frame, as a camera sees them: position [m], quaternion wxyz, shape (n, 7).

        `config.sensing` states what is wrong with it.
        """
        reported = self._target.copy()
        reported[:, :3] += self._camera_error
        return self._sensing.sense(reported[:, None], self.frame)[:, 0]

    def judge(self, truth: ArmTruth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        config = self.config
        distance, angle = self._errors(truth)
        new = running & ~self._started
        # The first frame's motion is part of it, but the start itself was not judged; at 25 frames a second that is
        # a fraction of a per cent of the way.
        self._first[new] = self._last[new] = np.maximum(distance[new], config.tolerance_m)
        self._started |= new
        reward = np.where(running, (self._last - distance) / self._first, 0.0)
        self._last[running], self._angle[running] = distance[running], angle[running]
        there = (distance <= config.tolerance_m) & (angle <= math.radians(config.tolerance_deg))
        self._within[running] = np.where(there, self._within + 1, 0)[running]
        event = self.count_frame(running)
        event[running & (self._within >= self._hold)] = Event.SUCCESS
        event[running & (truth.arm_on_table | truth.self_contact)] = Event.COLLISION
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        success = event == Event.SUCCESS
        covered = 1.0 if success else min(1.0, max(0.0, 1 - self._last[sim] / self._first[sim]))
        return Outcome(
            success=success,
            event=event,
            score=float(covered),
            details={"error_m": float(self._last[sim]), "error_rad": float(self._angle[sim])},
        )

    def _errors(self, truth: ArmTruth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distance [m] and angle [rad] between tool and target, each of shape (n,)."""
        apart = truth.tool_pose[:, :3] - self._target[:, :3]
        distance = np.sqrt((apart * apart).sum(axis=1))
        cosine = np.abs((truth.tool_pose[:, 3:] * self._target[:, 3:]).sum(axis=1))
        return distance, 2 * np.arccos(np.minimum(cosine, 1.0))

    @cached_property
    def _kinematics(self) -> ArmKinematics:
        return ArmKinematics(self.arm.chain, self.arm.limits)

    def _draw_posture(self, rng: np.random.Generator, spread: float | Sequence[float]) -> NDArray[np.float64]:
        """Return a posture around home; each joint is turned by at most `spread` [rad]."""
        home, most = np.array(self.arm.home[: len(self.arm.chain.joints)]), np.asarray(spread, np.float64)
        return home + rng.uniform(-most, most, len(home))

    def _draw_start(self, rng: np.random.Generator) -> tuple[float, ...]:
        for _ in range(_TRIES):
            posture = self._draw_posture(rng, self.config.start_spread_rad)
            if self._kinematics.check(posture) == ResultCode.SUCCEEDED:
                return tuple(posture.tolist())
        raise ConfigError("No posture near the arm's home is free; give another home.")

    def _draw_target(self, rng: np.random.Generator) -> tuple[float, ...]:
        """Return a pose that an admissible posture has: reachable by construction."""
        kinematics, workspace = self._kinematics, self.arm.workspace
        least, (low, high) = _AWAY_FROM_SINGULAR * kinematics.chain.min_manipulability, np.array(workspace.tool)
        for _ in range(_TRIES):
            posture = self._draw_posture(rng, workspace.around_home)
            tool = kinematics.tool(posture)
            if not ((tool[:3, 3] >= low) & (tool[:3, 3] <= high)).all() or kinematics.manipulability(posture) < least:
                continue
            if kinematics.check(posture) == ResultCode.SUCCEEDED:
                return tuple(pose_vectors(tool).tolist())
        raise ConfigError(
            "The arm reaches no pose within its workspace from postures near its home; give another home."
        )
