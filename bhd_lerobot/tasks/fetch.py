"""Bring an object from one stand to another."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, Drive, GripperSpec, LidarSpec
from bhd_lerobot.bodies.fetch_scene import MOST_OBSTACLES, FetchScene, make_fetch_scene
from bhd_lerobot.bodies.registry import body_with
from bhd_lerobot.bodies.tabletop import COLOURS, OBJECT_FIELDS
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive, Range
from bhd_lerobot.tasks.navigate import goal_in_robot
from bhd_lerobot.tasks.task import Event, Outcome, Task, TaskConfig

ENVIRONMENT = (
    *(f"object_0_{name}" for name in OBJECT_FIELDS),
    *("object_0_ahead_cos", "object_0_ahead_sin"),
    *("place_x", "place_y", "place_z", "place_ahead_cos", "place_ahead_sin"),
)
_FALLEN = 0.03  # [m] below the lower stand the middle of an object is not on one
_STANDS = 0.01  # [m] by which the middle of an object that stands may be higher or lower
_AT_REST = 0.03  # [m/s]


@TaskConfig.register_subclass("fetch")
@dataclass
class FetchConfig(TaskConfig):
    """What the fetch task asks for.

    Attributes:
        duration_s: longest duration of an episode [s].
        tolerance_m: distance of the object from its place that counts as there [m].
        hold_s: time that it must stand there, let go of [s].
        max_obstacles: largest number of obstacles in the room, beside the stands.
    """

    duration_s: Positive = 120.0
    tolerance_m: Positive = 0.05
    hold_s: Positive = 0.5
    max_obstacles: Annotated[int, Range(f"[0, {2 * MOST_OBSTACLES}]")] = MOST_OBSTACLES


class FetchTask(Task):
    """The fetch task for n simulations.

    Success: the object stands within `tolerance_m` of its place, at rest and let go of, for `hold_s`. Failures:
    `collision` (the robot touches the scene or itself, or a link other than the gripper the object), `dropped` (the
    object fell off) and `timeout`. Score: the share of the straight way to its place that the object has come, 0.9 at
    the most; 1 for a success. The reward of a frame is what it adds to the score.
    """

    name = "fetch"
    needs: tuple[type, ...] = (Drive, Arm, GripperSpec, LidarSpec)
    never = (Event.STUCK, Event.WRONG_OBJECT, Event.UNREACHABLE)
    environment_names = ENVIRONMENT

    def __init__(self, config: FetchConfig, n: int, fps: int, body: Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self._hold = self.in_frames(config.hold_s)
        self._fixed = np.zeros((n, len(OBJECT_FIELDS)))
        self._stands = np.zeros((n, 2, 4))  # x, y, yaw and height of the one with the object, and of its place
        self._middle = np.zeros(n)  # height of the middle of the object above what it stands on [m]
        self._at, self._way = np.zeros((n, 3)), np.ones(n)
        self._best, self._there = np.zeros(n), np.zeros(n, np.int64)

    def sample(self, seed: int) -> FetchScene:
        """Return the scene of the episode with this seed."""
        return make_fetch_scene(seed, self.body or body_with(*self.needs), self.config.max_obstacles)

    def instruction(self, scene: FetchScene) -> str:
        """Return what a person would ask for."""
        return scene.instruction

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[FetchScene]) -> None:
        """Start episodes in some simulations."""
        super().begin(ids, scenes)
        for sim, scene in zip(ids, scenes, strict=True):
            if not isinstance(scene, FetchScene) or not scene.objects:
                raise ConfigError(f"The scene {scene.name!r} has no object to fetch.")
            one = scene.objects[0]
            colour = np.clip(np.array(COLOURS[one.colour]) + one.shade, 0.0, 1.0)
            self._fixed[sim, :3] = 1.0, 1.0, one.kind == "box"
            self._fixed[sim, 10:] = 2 * one.size_x, 2 * one.size_y, one.height, *colour
            self._stands[sim] = [(stand.x, stand.y, stand.yaw, stand.height) for stand in (scene.pick, scene.place)]
            self._middle[sim] = one.height / 2
            self._at[sim] = one.x, one.y, scene.stand_m + one.height / 2
            self._way[sim] = max(math.dist((one.x, one.y), (scene.place.x, scene.place.y)), self.config.tolerance_m)
        self._best[ids], self._there[ids] = 0.0, 0

    def environment_state(self, truth: Any) -> NDArray[np.float64]:
        """Return what is known of the object and its place, in the robots' frames, shape (n, 23).

        The object as the pick task reports one; cosine and sine of the direction in which one looks who stands before
        its stand; the place on top of the other stand, and that direction there. `truth`: of arms on bases.
        """
        ends = [goal_in_robot(self._stands[:, k, :3], truth.base_pose_in_world) for k in (0, 1)]
        state = self._fixed.copy()
        state[:, 3:10] = truth.object_poses[:, 0]
        place = np.concatenate([ends[1][:, :2], self._stands[:, 1, 3:], ends[1][:, 2:]], axis=1)
        return np.concatenate([state, ends[0][:, 2:], place], axis=1)

    def judge(self, truth: Any, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        x, y, z = truth.object_poses[:, 0, :3].T
        base_x, base_y, yaw = truth.base_pose_in_world.T
        cos, sin = np.cos(yaw), np.sin(yaw)
        at = np.stack([base_x + cos * x - sin * y, base_y + sin * x + cos * y, z], axis=1)
        place = self._stands[:, 1]
        is_at_rest = np.linalg.norm(at - self._at, axis=1) * self.fps <= _AT_REST
        left = np.hypot(*(at[:, :2] - place[:, :2]).T)
        stands = np.abs(z - place[:, 3] - self._middle) <= _STANDS
        there = (left <= self.config.tolerance_m) & stands & is_at_rest & ~truth.fingers_on_object[:, 0]
        np.copyto(self._there, (self._there + 1) * there, where=running)
        np.copyto(self._at, at, where=running[:, None])
        best = np.maximum(self._best, 0.9 * np.clip(1.0 - left / self._way, 0.0, 1.0))
        event = self.count_frame(running)
        for name, happened in (
            (Event.DROPPED, z < self._stands[:, :, 3].min(axis=1) - _FALLEN),
            (Event.SUCCESS, self._there >= self._hold),
            (Event.COLLISION, truth.touched | truth.arm_on_table | truth.self_contact | truth.arm_on_object),
        ):
            event[running & happened] = name
        best[event == Event.SUCCESS] = 1.0
        reward = (best - self._best) * running
        np.copyto(self._best, best, where=running)
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        success = event == Event.SUCCESS
        left = float(np.hypot(*(self._at[sim, :2] - self._stands[sim, 1, :2])))
        details = {"left_m": left, "time_s": float(self.frame[sim]) / self.fps}
        return Outcome(success, event, 1.0 if success else float(self._best[sim]), details)
