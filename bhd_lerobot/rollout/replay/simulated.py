"""`bhd-replay`: run a recorded episode again, and report how far it diverges.

Open loop: the recorded actions, from the recorded initial state, through a new cerebellum and new physics. State-exact:
the robot is put into each recorded physics state, and its sensors are read again.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.bodies.scenes import scene_from_json
from bhd_lerobot.control.commands import BrainCommand, Goals
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.registry import make_simulation, recorded_robot
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.provenance import command_from_json, versions
from bhd_lerobot.rollout.replay.config import ReplayConfig, root_of


@dataclass(frozen=True)
class Divergence:
    """How far a replay is from its recording, per frame.

    Attributes:
        mode: how it was replayed.
        position_m: distance of the base positions [m], shape (frames,).
        angle_rad: difference of the base's yaw [rad], shape (frames,).
        state: largest difference of any recorded physics value, in its own unit, shape (frames,).
        observation: largest difference of any compared observation, in its own unit, shape (frames,).
        recorded_xy: recorded positions of base or tool [m], shape (frames, 2).
        replayed_xy: replayed positions of base or tool [m], shape (frames, 2).
        not_compared: observations that this mode cannot reproduce.
    """

    mode: str
    position_m: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    state: NDArray[np.float64]
    observation: NDArray[np.float64]
    recorded_xy: NDArray[np.float64]
    replayed_xy: NDArray[np.float64]
    not_compared: tuple[str, ...] = ()

    @property
    def identical(self) -> bool:
        """Whether states and observations are the recorded ones, bit for bit."""
        return not self.state.any() and not self.observation.any()

    def __repr__(self) -> str:
        worst = "identical" if self.identical else f"position up to {self.position_m.max():.3g} m apart"
        return f"Divergence(mode={self.mode!r}, {len(self.state)} frames, {worst})"


class Replay:
    """One recorded episode and a simulation of its robot."""

    def __init__(self, root: Path, episode: int) -> None:
        summary = dataset_info(root)
        self.columns = read_episode(root, episode)
        metadata = summary.episodes[episode].metadata
        if plant := summary.recording.get("robot", {}).get("plant"):
            raise DatasetError(
                f"{root} was recorded on a robot that is not simulated, by the plant {plant}: there is no world to "
                "replay it in. Send its actions to the robot: add --robot.type=…."
            )
        missing = [key for key in (keys.PHYSICS_STATE, keys.ACTION, keys.AGE) if key not in self.columns]
        missing += [key for key in ("scene", "initial_state", "seed") if key not in metadata]
        if missing or "robot" not in summary.recording:
            raise DatasetError(
                f"{root} was not recorded by bhd-record: it lacks {', '.join(missing) or 'the robot parameters'}. "
                "Send its actions to a robot: add --robot.type=…."
            )
        self.metadata = metadata
        self.scene = scene_from_json(metadata["scene"])
        self.seed = int(metadata["seed"])
        self.fps = summary.fps
        self.simulation = make_simulation(recorded_robot(summary.recording["robot"]))
        self.goals: dict[int, list[BrainCommand]] | None = None
        if metadata.get("goals"):
            self.goals = {}
            for frame, fields_ in json.loads(metadata["goals"]):
                self.goals.setdefault(frame, []).append(command_from_json(fields_))
        # Some episodes followed goals in some frames, and setpoints in the others: the recorded actions.
        self._by_goals = np.full(len(self.columns[keys.ACTION]), self.goals is not None)
        if metadata.get("goal_frames"):
            self._by_goals[:] = False
            for first, end in json.loads(metadata["goal_frames"]):
                self._by_goals[first:end] = True
        self._initial = np.asarray(metadata["initial_state"], np.float64)
        self.is_live = summary.recording["robot"].get("clock") == "realtime"
        self.differing: list[str] = summary.recording.get("differing", [])

    def changed_versions(self) -> dict[str, tuple[str, str]]:
        """Return what has another version than at the recording: name to recorded and present version."""
        recorded = json.loads(self.metadata["versions"])
        return {
            name: (recorded.get(name, "none"), now) for name, now in versions().items() if recorded.get(name) != now
        }

    def open_loop(self) -> Divergence:
        """Replay the recorded commands from the recorded initial state.

        They are the recorded actions, or, where the robot was driven by goals, the goals.
        """
        simulation = self._start()
        actions = self.columns[keys.ACTION].astype(np.float64)
        states, observations = [], []
        for frame, action in enumerate(actions):
            states.append(simulation.physics_state[0])
            observations.append(simulation.observe().state[0])
            if self.goals is not None and self._by_goals[frame]:
                simulation.step(Goals({0: self.goals.get(frame, [])}))
            else:
                simulation.step(action[None])
        return self._compare("open_loop", np.array(states), np.array(observations), ())

    def state_exact(self) -> Divergence:
        """Put the robot into every recorded state and read its sensors again."""
        simulation = self._start()
        states, observations = [], []
        ages = self.columns[keys.AGE]
        for frame, state in enumerate(self.columns[keys.PHYSICS_STATE]):
            simulation.restore_physics(0, state)
            simulation.resense(0, float(self.columns[keys.TIME][frame]), float(ages[frame]))
            states.append(simulation.physics_state[0])
            observations.append(simulation.observe().state[0])
        return self._compare("state", np.array(states), np.array(observations), simulation.not_in_state)

    def _start(self) -> Simulation:
        simulation = self.simulation
        first = np.zeros(1, np.intp)
        simulation.reset(first, [self.scene], [self.seed])
        world = simulation.world
        if self._initial.shape != world.snapshot().state.shape[1:]:
            raise DatasetError(
                f"The recorded initial state has {len(self._initial)} numbers; this version's simulation has "
                f"{world.snapshot().state.shape[1]}. Replay it with the versions that recorded it: "
                f"{self.metadata['versions']}."
            )
        world.restore(replace(world.snapshot(), state=self._initial[None]))
        return simulation

    def _compare(
        self, mode: str, states: NDArray[np.float64], observations: NDArray[np.float64], skipped: tuple[str, ...]
    ) -> Divergence:
        recorded = self.columns[keys.PHYSICS_STATE]
        names = self.simulation.observation_names
        compared = np.array([name not in skipped for name in names])
        # A scan that fell between two frames is not in any recorded state.
        fresh = self.columns[keys.AGE] == 0 if mode == "state" else np.ones(len(recorded), bool)
        scan = np.array([name.startswith("scan_") for name in names])
        difference = np.abs(observations.astype(np.float32) - self.columns[keys.OBSERVATION_STATE])
        difference[np.ix_(~fresh, scan)] = 0.0
        now, then = self.simulation.track(states), self.simulation.track(recorded)
        return Divergence(
            mode=mode,
            position_m=np.sqrt(((now[:, :3] - then[:, :3]) ** 2).sum(axis=1)),
            angle_rad=_angle(now[:, 3:], then[:, 3:]),
            state=np.abs(states - recorded).max(axis=1),
            observation=difference[:, compared].max(axis=1),
            recorded_xy=then[:, :2],
            replayed_xy=now[:, :2],
            not_compared=skipped,
        )


def replay(config: ReplayConfig, console: Console | None = None) -> list[Divergence]:
    """Replay an episode in simulation, print how far it diverges, and draw it."""
    console = console or Console(stderr=True)
    root = root_of(config)
    episode = Replay(root, config.dataset.episode)
    folder = Path(config.output_dir or "outputs/replay").expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"The folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error
    for name, (then, now) in episode.changed_versions().items():
        console.print(f"Recorded with {name} {then}, replayed with {now}: differences may come from that.")
    if episode.differing:
        console.print(
            f"Merged of recordings with different {', '.join(episode.differing)}: of these it is replayed with the "
            "defaults, and differences may come from that. The datasets that it was merged of know them."
        )
    if episode.is_live:
        console.print(
            "Recorded on the wall clock: commands took effect when they came, not at the start of a frame. open_loop "
            "gives them at the start and so differs; state shows whether the record is true to itself."
        )
    results = []
    title = escape(f"Replay of episode {config.dataset.episode} of {root}: largest differences")
    table = Table(title=title, title_justify="left")
    for heading in ("mode", "position [m]", "angle [rad]", "state", "observed", ""):
        table.add_column(heading, justify="left" if heading in ("mode", "") else "right", no_wrap=True)
    for mode in ("open_loop", "state") if config.mode == "both" else (config.mode,):
        result = episode.open_loop() if mode == "open_loop" else episode.state_exact()
        results.append(result)
        table.add_row(
            mode,
            *(
                f"{values.max():.3g}"
                for values in (result.position_m, result.angle_rad, result.state, result.observation)
            ),
            "identical" if result.identical else "",
        )
        if result.not_compared:
            table.caption = f"Not compared in mode state: {', '.join(result.not_compared)}."
        curves: dict[str, Any] = {
            "position [m]": result.position_m,
            "angle [rad]": result.angle_rad,
            "observation, largest": result.observation,
        }
        time = np.arange(len(result.state)) / episode.fps
        heading = f"Episode {config.dataset.episode}, replay of the {mode.replace('_', ' ')}"
        path = folder / f"episode_{config.dataset.episode:06d}_{mode}.png"
        from bhd_lerobot.rollout.plots import draw_divergence

        draw_divergence(
            scene=episode.scene,
            recorded=result.recorded_xy,
            replayed=result.replayed_xy,
            time=time,
            curves=curves,
            heading=heading,
            path=path,
        )
    console.print(table)
    console.print(escape(f"Plots: {folder}"), soft_wrap=True)
    return results


def _angle(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles between orientations, exactly 0 for equal ones."""
    # A quaternion and its negative are the same orientation.
    apart, across = first - second, first + second
    chord = np.sqrt(np.minimum((apart * apart).sum(axis=1), (across * across).sum(axis=1)))
    return np.asarray(4 * np.arcsin(np.minimum(chord / 2, 1.0)))
