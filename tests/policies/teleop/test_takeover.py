"""A brain from which a person takes over, and to which they give back."""

import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import Chunk, Goals
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.reach import ReachBrain, ReachBrainConfig
from bhd_lerobot.policies.teleop.takeover import TakeoverBrain
from bhd_lerobot.registry import make_task
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.host import LeRobotHost
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.marks import Marks
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.free import FreeConfig
from bhd_lerobot.tasks.task import Event
from tests.robots.external.mock_devices.devices import JOINTS, MockArm, MockArmConfig

SEEN = Observation(("a.pos",), np.zeros((1, 1)))


class Counting(Brain):
    """Says which action it is, since its last reset; looks in the first alone."""

    uses_images = True

    def __init__(self, name: str, value: float) -> None:
        super().__init__(None)
        self.name, self._value, self.resets, self._count = name, value, 0, 0
        self.held: list[Any] = []

    def bind(self, robot: RobotFeatures) -> None:
        self.bound = robot

    def reset(self, ids: Any, seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        self.resets, self._count = self.resets + 1, 0

    def hold(self, action: Any) -> None:
        self.held.append(None if action is None else float(action[0, 0]))

    def needs_images(self, results: Any) -> Any:
        return np.array([self._count == 0])

    def act(self, observation: Observation) -> Any:
        self._count += 1
        return np.array([[self._value + self._count]])

    def parameters(self) -> dict[str, Any]:
        return {"type": self.name}

    def close(self) -> None:
        self.closed = True


@pytest.mark.law
def test_the_person_drives_while_they_have_taken_over_and_the_brain_starts_afresh() -> None:
    brain, person = Counting("policy", 0.0), Counting("teleop", 100.0)
    taken = [False, False, True, True, False, False]
    turns = iter(taken)
    both: Any = TakeoverBrain(brain, person, lambda: next(turns))  # type: ignore[arg-type]
    both.bind(RobotFeatures(("a.pos",), ("a.pos",), 10))
    both.reset(np.zeros(1, np.intp), [0], 1)
    looked, actions, interventions = [], [], []
    for _ in taken:
        # Who drives is settled once a frame: a key between the two calls takes effect in the next.
        looked.append(bool(both.needs_images({})[0]))
        actions.append(float(both.act(SEEN)[0, 0]))
        interventions.append(bool(both.interventions()[0]))
    assert actions == [1.0, 2.0, 101.0, 102.0, 1.0, 2.0]
    assert person.held == [2.0]
    assert interventions == taken
    assert looked == [True, False, True, False, True, False]
    assert both.parameters() == {"type": "policy", "takeover": {"type": "teleop"}}
    both.close()
    assert person.closed


class Streaming(Counting):
    """Gives a chunk of five actions in its first frame."""

    def act(self, observation: Observation) -> Any:
        first = super().act(observation) if self._count == 0 else None
        return None if first is None else Chunk(first + np.arange(5.0)[:, None, None])


class Silent(Counting):
    """Gives an action in its third frame, and none before."""

    def act(self, observation: Observation) -> Any:
        action = super().act(observation)
        return action if self._count > 2 else None


@pytest.mark.law
def test_who_takes_over_and_does_nothing_yet_ends_what_a_chunk_would_go_on_with() -> None:
    brain, person, frames = Streaming("policy", 0.0), Silent("teleop", 100.0), iter(range(99))
    both: Any = TakeoverBrain(brain, person, lambda: 2 <= next(frames) < 6)  # type: ignore[arg-type]
    both.bind(RobotFeatures(("a.pos",), ("a.pos",), 10))
    both.reset(np.zeros(1, np.intp), [0], 1)
    commands = [both.act(SEEN) for _ in range(8)]
    given = [None if one is None or isinstance(one, Chunk) else float(one[0, 0]) for one in commands]
    # In the second frame the chunk's second action was in force.
    assert given == [None, None, 2.0, None, 103.0, 104.0, None, None]
    assert [isinstance(one, Chunk) for one in commands] == [True] + [False] * 5 + [True, False]
    assert person.held == [2.0]


def test_of_a_brain_that_gives_goals_nothing_is_held() -> None:
    class Asking(Counting):
        def act(self, observation: Observation) -> Any:
            return Goals({})

    person, frames = Counting("teleop", 100.0), iter(range(99))
    both: Any = TakeoverBrain(Asking("plugin", 0.0), person, lambda: next(frames) > 0)  # type: ignore[arg-type]
    both.bind(RobotFeatures(("a.pos",), ("a.pos",), 10))
    both.reset(np.zeros(1, np.intp), [0], 1)
    assert [type(both.act(SEEN)) for _ in range(2)] == [Goals, np.ndarray]
    assert person.held == [None]


@pytest.mark.law
def test_what_a_person_does_is_what_the_expert_would_do(tmp_path: Path) -> None:
    class Advised(Counting):
        def advice(self) -> Any:
            return np.full((1, len(JOINTS)), 10.0 * self._count)

        def interventions(self) -> Any:
            return np.array([self._count == 2])

        def causes(self) -> Sequence[str]:
            return ["stalled"]

        def act(self, observation: Observation) -> Any:
            return np.repeat(super().act(observation), len(JOINTS), axis=1)

    brain, person, frames = Advised("policy", 0.0), Advised("teleop", 1.0), iter(range(99))
    both: Any = TakeoverBrain(brain, person, lambda: 2 <= next(frames) < 5)  # type: ignore[arg-type]
    robot = MockArm(MockArmConfig(id="arm", calibration_dir=tmp_path))
    robot.connect()
    with closing(LeRobotHost(robot, 10, GateConfig())) as host:
        loop = EpisodeLoop(host, make_task(FreeConfig(duration_s=0.8), 1, 10, None), both)
        (episode,) = loop.run([EpisodeSpec(0, 0)])
    action, expert = episode.columns[keys.ACTION], episode.columns[keys.EXPERT_ACTION]
    # An expert that took over from the brain by itself has intervened, too.
    spans = [(one.first, one.end, one.cause) for one in episode.interventions or []]
    assert spans[0] == (1, 5, "stalled")
    assert np.array_equal(expert[2:5], action[2:5])
    assert expert[:2, 0].tolist() == [10.0, 20.0]


def test_nobody_takes_over_from_goals() -> None:
    with pytest.raises(ConfigError, match="gives goals"):
        TakeoverBrain(ReachBrain(ReachBrainConfig()), Counting("teleop", 0.0), lambda: False)  # type: ignore[arg-type]


class Driver(Counting):
    """Takes its time for an action."""

    def act(self, observation: Observation) -> Any:
        super().act(observation)
        time.sleep(0.07 if self.name == "policy" else 0.0)
        if self.name == "policy" and self._count == 3:
            self.marks.intervention(True)  # a person presses the key while the policy is computing
        return np.full((1, len(JOINTS)), self._value)


class Late(Counting):
    """Is still computing when the episode's time is up."""

    def act(self, observation: Observation) -> Any:
        super().act(observation)
        if self.resets == 1 and self._count == 3:
            self.marks.again()
            time.sleep(0.4)
        return np.ones((1, len(JOINTS)))


def test_a_take_that_ends_before_its_discard_is_seen_is_discarded(tmp_path: Path) -> None:
    brain = Late("policy", 1.0)
    robot = MockArm(MockArmConfig(id="arm", calibration_dir=tmp_path))
    robot.connect()
    with closing(LeRobotHost(robot, 50, GateConfig())) as host:
        loop = EpisodeLoop(host, make_task(FreeConfig(duration_s=0.3), 1, 50, None), brain)  # type: ignore[arg-type]
        brain.marks = loop.marks
        episodes = list(loop.run([EpisodeSpec(0, 0)]))
    assert len(episodes) == 1
    assert brain.resets == 2


def test_frames_are_flagged_from_the_first_action_of_the_person_on(tmp_path: Path) -> None:
    marks, brain, person = Marks(hands_over=True), Driver("policy", 1.0), Driver("teleop", 2.0)
    brain.marks = marks
    both: Any = TakeoverBrain(brain, person, marks.is_driving)  # type: ignore[arg-type]
    robot = MockArm(MockArmConfig(id="arm", calibration_dir=tmp_path))
    robot.connect()
    with closing(LeRobotHost(robot, 50, GateConfig())) as host:
        loop = EpisodeLoop(host, make_task(FreeConfig(duration_s=0.6), 1, 50, None), both)
        loop.marks = marks
        (episode,) = loop.run([EpisodeSpec(0, 0)])
    by_person = episode.columns[keys.ACTION][:, 0] == 2.0
    assert by_person.any()
    flagged = episode.columns[keys.EVENT][:-1] == Event.INTERVENTION
    assert flagged.tolist() == by_person[:-1].tolist()
    (span,) = episode.interventions or []
    assert span.first == np.flatnonzero(by_person)[0]
