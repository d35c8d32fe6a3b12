"""Brains that plan several frames ahead: what a chunk does is what its actions, sent one by one, would have done."""

import os
import signal
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand, Chunk, Goals
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.brain import Brain, is_privileged
from bhd_lerobot.registry import make_robot, make_simulation, make_task
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.free import FreeConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.task import Event
from tests.robots.host import lying_arm
from tests.robots.host.support import relaxed, unique

FRAMES = 20


class Script(Brain):
    """Plays the rows of a script: one by one, or `length` of them at a time, every `every` frames."""

    name = "script"

    def __init__(self, rows: np.ndarray, length: int = 0, every: int = 1) -> None:
        self.rows, self.length, self.every = rows, length, every
        self.frame = 0

    def bind(self, *args: Any) -> None:
        pass

    def reset(self, *args: Any) -> None:
        self.frame = 0

    def act(self, observation: Any) -> Any:
        frame = self.frame
        self.frame += 1
        n = len(observation.state)
        if not self.length:
            return np.tile(self.rows[frame], (n, 1))
        if frame % self.every:
            return None
        return Chunk(np.tile(self.rows[frame : frame + self.length][:, None], (1, n, 1)))

    def parameters(self) -> dict[str, Any]:
        return {}


def run(kind: str, brain: Script, n: int = 2) -> list[Episode]:
    if kind == "ur5":
        simulation = make_simulation(UR5Config(), n)
        task = make_task(ReachConfig(duration_s=FRAMES / 25), n, 25)
    else:
        simulation = make_simulation(TurtleBot3Config(beams=36), n)
        task = make_task(AvoidConfig(duration_s=FRAMES / 10), n, 10)
    return list(EpisodeLoop(simulation, task, brain).run([EpisodeSpec(i, 2 * i) for i in range(3)]))


@pytest.mark.parametrize(("declared", "told"), [(True, True), (False, False), (None, True)])
def test_what_no_sensor_tells_is_for_brains_that_say_that_they_use_it(declared: bool | None, told: bool) -> None:
    """Of a brain that says nothing, such as an older plug-in's, it is taken for granted."""
    seen = []

    class Spy(Script):
        def act(self, observation: Any) -> Any:
            seen.append(observation.environment_state)
            return super().act(observation)

    brain = Spy(script("ur5"))
    if declared is not None:
        brain.uses_privileged_state = declared
    assert is_privileged(brain, ["target.x"]) == told  # type: ignore[arg-type]
    episodes = run("ur5", brain)
    assert {one is not None for one in seen} == {told}
    # It is recorded all the same.
    assert episodes[0].columns["observation.environment_state"].shape[1] == 7


def script(kind: str) -> np.ndarray:
    time = np.arange(2 * FRAMES)
    if kind == "ur5":
        home = np.array(UR5Config().body().arm.home)
        return home + 0.02 * np.sin(time / 4)[:, None] * np.array([1, -1, 1, 2, -2, 3, 0.0])
    return np.stack([0.1 + 0.05 * np.sin(time / 3), 0.8 * np.cos(time / 5)], axis=1)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("kind", ["turtlebot3", "ur5"])
@pytest.mark.parametrize(("length", "every"), [(8, 3), (30, 10), (1, 1)])
def test_a_chunk_does_what_its_actions_sent_one_by_one_do(kind: str, length: int, every: int) -> None:
    rows = script(kind)
    one_by_one, chunked = run(kind, Script(rows)), run(kind, Script(rows, length, every))
    assert len(one_by_one) == len(chunked) == 3
    for first, second in zip(one_by_one, chunked, strict=True):
        assert first.columns.keys() == second.columns.keys()
        for key, column in first.columns.items():
            np.testing.assert_array_equal(second.columns[key], column, err_msg=key)


class Interrupted(Script):
    """Gives a chunk in the first frame, whose rows are the script's for three frames, and single rows after these."""

    def act(self, observation: Any) -> Any:
        frame, self.frame = self.frame, self.frame + 1
        n = len(observation.state)
        if frame > 2:
            return np.tile(self.rows[frame], (n, 1))
        rows = np.concatenate([self.rows[:3], np.tile(self.rows[0], (20, 1))])
        return None if frame else Chunk(np.tile(rows[:, None], (1, n, 1)))


@pytest.mark.law
@pytest.mark.parametrize("kind", ["turtlebot3", "ur5"])
def test_an_action_takes_the_place_of_what_is_left_of_a_chunk(kind: str) -> None:
    """As where a person takes over from a policy that streams."""
    rows = script(kind)
    for first, second in zip(run(kind, Script(rows)), run(kind, Interrupted(rows)), strict=True):
        for key, column in first.columns.items():
            np.testing.assert_array_equal(second.columns[key], column, err_msg=key)


def test_how_long_an_episode_may_last_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A person who ends takes by a key sets a time that is never over; there is room for what is recorded."""
    rows = script("turtlebot3")
    wanted = run("turtlebot3", Script(rows))
    monkeypatch.setattr("bhd_lerobot.rollout.episode._FIRST_FRAMES", 3)
    for one, other in zip(wanted, run("turtlebot3", Script(rows)), strict=True):
        for key, column in one.columns.items():
            np.testing.assert_array_equal(other.columns[key], column, err_msg=key)
    task = make_task(AvoidConfig(duration_s=1e12), 1, 10)
    loop = EpisodeLoop(make_simulation(TurtleBot3Config(beams=36), 1), task, Script(rows))
    assert list(loop.run([EpisodeSpec(0, 0)], lambda: loop.frames == 5)) == []


class Once(Script):
    """Gives an arm a goal in the first frame, and goes on with it."""

    def act(self, observation: Any) -> Any:
        frame, self.frame = self.frame, self.frame + 1
        return None if frame else Goals({0: [BrainCommand("there", joint_target=tuple(self.rows[FRAMES, :6]))]})


def test_goals_of_a_brain_that_goes_on_with_the_last_are_recorded() -> None:
    for episode in run("ur5", Once(script("ur5")), n=1):
        assert episode.commands is not None
        assert [(frame, goal.task_id) for frame, goal in episode.commands] == [(0, "there")]
        assert [result.success for _, result in episode.results] == [True]
        assert episode.goal_frames is None


class Breaker(Script):
    """Latches a fault in the first simulation, in its fifth frame."""

    def __init__(self, rows: np.ndarray) -> None:
        super().__init__(rows)
        self.simulation: Any = None
        self.is_broken = False

    def act(self, observation: Any) -> Any:
        if self.frame == 4 and not self.is_broken:
            self.is_broken = True
            self.simulation.cerebellum.reading.safety[0] = True
        return super().act(observation)


def test_a_latched_fault_ends_the_episode_and_the_next_one_moves_again() -> None:
    simulation = make_simulation(TurtleBot3Config(beams=36), 2)
    task = make_task(AvoidConfig(duration_s=FRAMES / 10), 2, 10)
    brain = Breaker(script("turtlebot3"))
    brain.simulation = simulation
    plant_fault = simulation.cerebellum.reading.safety
    episodes = []
    for episode in EpisodeLoop(simulation, task, brain).run([EpisodeSpec(i, 2 * i) for i in range(3)]):
        plant_fault[:] = False
        episodes.append(episode)
    first, second, third = episodes
    assert first.outcome.event == Event.FAULT
    assert not first.outcome.success
    assert first.frames == 5
    assert first.columns[keys.MODE][-1] == Mode.FAULT
    assert first.columns[keys.EVENT].tolist() == [0, 0, 0, 0, Event.FAULT]
    for other in (second, third):
        assert other.outcome.event != Event.FAULT
        assert other.frames == FRAMES
        assert (other.columns[keys.MODE] != Mode.FAULT).all()
    assert np.abs(third.columns[keys.APPLIED_ACTION]).max() > 0.05


def test_no_image_is_made_of_frames_that_went_by_unless_somebody_looks() -> None:
    """Images that nobody looks at would keep a brain that is late from catching up."""

    class Slow(Script):
        uses_images = True

        def act(self, observation: Any) -> Any:
            time.sleep(0.35 if self.frame == 1 else 0)  # at 10 frames a second
            return super().act(observation)

    options: dict[str, Any] = {"camera": True, "camera_width": 64, "camera_height": 48, "beams": 36}
    config = TurtleBot3Config(id=unique("images"), clock="realtime", realtime=relaxed(), **options)
    with closing(make_robot(config)) as robot:
        render = robot.render_later
        for is_watched in (False, True):
            brain, made = Slow(script("turtlebot3")), []
            robot.render_later = lambda *order, made=made: (made.append(order), render(*order))[1]
            loop = EpisodeLoop(robot, make_task(AvoidConfig(duration_s=FRAMES / 10), 1, 10), brain)
            loop.observer = (lambda *_: None) if is_watched else None
            (episode,) = loop.run([EpisodeSpec(0, 0)])
            frames = len(episode.columns["action"])
            assert brain.frame < frames
            assert len(made) == len(robot.camera_shapes) * (frames if is_watched else brain.frame)


def test_what_was_recorded_of_a_robot_whose_process_is_killed_is_an_episode(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv(lying_arm.LOG, str(tmp_path / "shared"))
    lying_arm.shared(str(tmp_path / "shared"), new=True)
    plant, realtime = f"{lying_arm.__name__}:LyingArm", relaxed(plant_timeout_s=5.0)
    config = UR5Config(id=unique("killed"), clock="realtime", plant=plant, control_hz=125, realtime=realtime)
    home = np.tile(config.body().arm.home, (1000, 1))

    with closing(make_robot(config)) as robot:

        class Killer(Script):
            def act(self, observation: Any) -> Any:
                if self.frame == 10:
                    os.kill(robot.link.pid, signal.SIGKILL)
                return super().act(observation)

        loop = EpisodeLoop(robot, make_task(FreeConfig("hold still"), 1, 25, config.body()), Killer(home))
        (episode,) = loop.run([EpisodeSpec(i, 2 * i) for i in range(2)])
    assert loop.fault
    assert "was killed by signal 9" in loop.problem
    assert episode.outcome.event == Event.FAULT
    assert episode.frames >= 10
    assert {len(column) for column in episode.columns.values()} == {episode.frames}
    assert episode.columns[keys.EVENT].tolist() == [0] * (episode.frames - 1) + [Event.FAULT]
    assert episode.columns[keys.DONE].tolist() == [False] * (episode.frames - 1) + [True]
