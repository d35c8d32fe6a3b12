"""A base with large wheels, a corridor to drive through, and a brain that follows the wall on its right."""

from dataclasses import dataclass

import numpy as np

import bhd_lerobot as bhd


@dataclass(kw_only=True)
class RoverConfig(bhd.MobileBaseConfig):
    """Options of the robot type ``rover``."""

    def body(self) -> bhd.Body:
        """Return a box of 24 by 18 by 8 cm on wheels of 12 cm."""
        return bhd.differential_base(
            "rover", wheel_radius=0.06, wheel_separation=0.20, size=(0.24, 0.18, 0.08), mass=2.5,
            max_velocity=(0.5, 2.5), colour=(0.8, 0.3, 0.2), lidar_noise_std=self.lidar_noise_std,
            command_timeout_s=self.command_timeout_s, camera_width=self.camera_width, camera_height=self.camera_height,
        )  # fmt: skip


@bhd.register_robot
class Rover(bhd.SimulatedBase):
    """A rover."""

    config_class = RoverConfig
    name = "rover"


def corridor(seed: int, robot_radius: float) -> bhd.Arena:
    """Return two walls of 6 m, as far apart as the seed says."""
    half = robot_radius + np.random.default_rng(seed).uniform(0.15, 0.35)
    sides = [bhd.Shape("box", 0.0, side * (half + 0.05), 0.0, 3.0, 0.05) for side in (-1, 1)]
    ends = [bhd.Shape("box", side * 3.05, 0.0, 0.0, 0.05, half + 0.1) for side in (-1, 1)]
    return bhd.Arena("corridor", (*sides, *ends), (-3.0, 3.0, -half, half), (-2.4, 0.0, 0.0))


bhd.register_arena("corridor", corridor)


@dataclass
class CorridorConfig(bhd.TaskConfig):
    """The end of the corridor is `goal_m` from its middle; an episode lasts `duration_s`."""

    goal_m: float = 2.0
    duration_s: float = 30.0


@bhd.register_task("corridor", CorridorConfig)
class Corridor(bhd.BaseTask):
    """Success: past the goal without a touch. Score: how much of the way was done."""

    def __init__(self, config: CorridorConfig, n: int, fps: int, body: bhd.Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self._x = np.zeros(n)

    def sample(self, seed: int) -> bhd.Arena:
        """Return the corridor of an episode."""
        return self.arena("corridor", seed)

    def instruction(self, scene: bhd.Arena) -> str:
        """Return what a person would ask for."""
        return "Drive to the other end of the corridor."

    def begin(self, ids: np.ndarray, scenes: list[bhd.Arena]) -> None:
        """Start episodes."""
        super().begin(ids, scenes)
        self._x[ids] = [scene.start[0] for scene in scenes]

    def judge(self, truth: object, running: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reward the way forward; a touch, the goal and the time end an episode."""
        x = np.where(running, truth.base_pose_in_world[:, 0], self._x)
        reward, self._x = x - self._x, x
        event = self.count_frame(running)
        event[running & (x > self.config.goal_m)] = bhd.Event.SUCCESS
        event[running & truth.touched] = bhd.Event.COLLISION
        return reward, event

    def outcome(self, sim: int, event: bhd.Event) -> bhd.Outcome:
        """Return how an episode ended."""
        score = np.clip((self._x[sim] + 2.4) / (self.config.goal_m + 2.4), 0, 1)
        return bhd.Outcome(event == bhd.Event.SUCCESS, event, float(score))


@dataclass
class WallFollowerConfig(bhd.BrainConfig):
    """Keep `distance_m` from the wall on the right at `speed` [m/s]."""

    distance_m: float = 0.28
    speed: float = 0.3


@bhd.register_brain("wall_follower", WallFollowerConfig)
class WallFollower(bhd.Brain):
    """Steers by the distance to the wall on the right and by the angle to it, a line through the beams there."""

    needs = (bhd.Drive, bhd.LidarSpec)

    def bind(self, robot: bhd.RobotFeatures) -> None:
        """Choose the beams within 45 degrees of the right."""
        self._scan, angles = bhd.find_scan(robot.observation_names, self.name)
        self._across = np.where(np.abs(angles + np.pi / 2) < 0.8, -np.sin(angles), 0.0)
        self._weights = angles + np.pi / 2

    def act(self, observation: bhd.Observation) -> np.ndarray:
        """Return the twist of each robot, shape (n, 2)."""
        across = observation.state[:, self._scan] * self._across
        beams, square = np.count_nonzero(self._across), (self._weights[self._across > 0] ** 2).sum()
        distance, slope = across.sum(axis=1) / beams, (across * self._weights).sum(axis=1) / square
        turn = 3.0 * (self.config.distance_m - distance) - 2.0 * slope / distance
        return np.stack([np.full(len(turn), self.config.speed), np.clip(turn, -1.5, 1.5)], axis=1)
