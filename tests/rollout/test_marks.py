"""What a person says during an episode is in its frames and in its outcome."""

import contextlib
import itertools
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.registry import make_simulation, make_task
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.marks import KEYS, TELEOP_KEYS, MarkKey, Marks
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.task import OUTCOMES, Event
from tests.cases import each_case

ALL = np.array([True, True])
NOTHING = np.zeros(2, np.int64)


def test_it_waits_for_its_simulation_and_not_for_the_next_episode() -> None:
    marks = Marks(2)
    marks.outcome("success", 1)
    assert marks.frame(NOTHING, np.array([True, False]))[0].tolist() == [0, 0]
    marks.begin(np.array([1]))
    assert marks.frame(NOTHING, ALL)[0].tolist() == [0, 0]


@pytest.mark.law
@pytest.mark.parametrize("hard", [Event.ESTOP, Event.FAULT])
def test_estop_and_fault_take_precedence_over_marks(hard: Event) -> None:
    marks = Marks(2)
    marks.outcome("success")
    marks.outcome("success", 1)
    assert marks.frame(np.array([hard, Event.TIMEOUT]), ALL)[0].tolist() == [hard, Event.SUCCESS]


@each_case(
    ("keys", "others", "typed"),
    [
        (KEYS, b"xe \r\t\x7f\xff", (b"sS", b"fF", b"iI", b"rR", b"pP")),
        (TELEOP_KEYS, b"sfirx e\xff", (b"\r\n", b"\x7f\b", b"\t", b"tT", b"pP")),
    ],
)
def test_keys(keys: tuple[MarkKey, ...], others: bytes, typed: tuple[bytes, ...]) -> None:
    success, failure, intervention, again, pause = typed
    seconds = itertools.count()
    marks = Marks(2, keys=keys, clock=lambda: float(next(seconds)))
    marks.on_key(others)
    assert marks.frame(NOTHING, ALL)[0].tolist() == [0, 0]
    assert not marks.frame(NOTHING, ALL)[1].any()
    assert not marks.take_again()
    assert not marks.is_paused
    for key in intervention:
        marks.on_key(others + bytes([key]))
        assert marks.frame(NOTHING, ALL)[1].tolist() == [True, False]
        marks.on_key(bytes([key]))
        assert not marks.frame(NOTHING, ALL)[1].any()
    for sent, event in ((success, Event.SUCCESS), (failure, Event.FAILURE)):
        for key in sent:
            marks.on_key(bytes([key, others[0]]))
            assert marks.frame(NOTHING, ALL)[0].tolist() == [event, 0]
    marks.on_key(failure + success)  # the last one counts
    assert marks.frame(NOTHING, ALL)[0].tolist() == [Event.SUCCESS, 0]
    for key in again:
        marks.on_key(bytes([key]))
        assert marks.take_again()
        assert not marks.take_again()
    for key in pause:
        marks.on_key(bytes([key]))
        assert marks.is_paused == (key == pause[0])
    with marks.waiting() as is_pressed:
        assert not is_pressed()
        marks.on_key(b"\r")  # begins the next episode, and is no success of it
        assert is_pressed()
    assert marks.frame(NOTHING, ALL)[0].tolist() == [0, 0]


class Keyboard:
    """Marks with a clock that stands still between two keys, and what was answered."""

    def __init__(self, keys: tuple[MarkKey, ...] = KEYS) -> None:
        self.now, self.answers = 100.0, list[str]()
        self.marks = Marks(keys=keys, shortest_s=0.5, clock=lambda: self.now)
        self.marks.answer = self.answers.append
        self.marks.begin(np.zeros(1, np.intp))
        self.now += 10.0

    def hold(self, key: bytes, seconds: float, first_s: float = 0.66, then_s: float = 0.03) -> None:
        """Hold a key, as a terminal sends it."""
        self.marks.on_key(key)
        pause, end = first_s, self.now + seconds
        while self.now + pause < end:
            self.now += pause
            self.marks.on_key(key)
            pause = then_s

    def frame(self) -> int:
        return int(self.marks.frame(np.zeros(1, np.int64), np.ones(1, np.bool_))[0][0])


@pytest.mark.law
@each_case(("first_s", "then_s"), [(0.66, 0.04), (0.25, 0.03), (0.5, 0.1)])
def test_a_key_that_is_held_is_one_key_whatever_it_means(first_s: float, then_s: float) -> None:
    for one in KEYS:
        board = Keyboard()
        board.hold(one.sent[:1], 3.0, first_s, then_s)
        assert len(board.answers) == 1, one
        assert board.marks.is_driving() == (one.meaning == "intervention")
        assert board.marks.is_paused == (one.meaning == "pause")
        assert board.marks.take_again() == (one.meaning == "again")
        assert not board.marks.take_again()
        # Held into the next take it does not end that one.
        board.frame()
        board.marks.begin(np.zeros(1, np.intp))
        board.now += 0.6
        for _ in range(40):
            board.now += then_s
            board.marks.on_key(one.sent[:1])
        assert board.frame() == Event.NOTHING
    board = Keyboard()
    with board.marks.waiting() as is_pressed:
        board.hold(b"\r", 0.1)
        assert is_pressed()
    board.marks.begin(np.zeros(1, np.intp))
    assert board.frame() == Event.NOTHING


def test_a_key_that_is_pressed_twice_is_two_keys() -> None:
    board = Keyboard()
    for is_on in (True, False, True):
        board.marks.on_key(b"i")
        assert board.marks.is_driving() == is_on
        board.now += 1.0


@each_case(("age_s", "event"), [(0.1, Event.NOTHING), (0.4, Event.NOTHING), (0.6, Event.SUCCESS)])
def test_a_take_that_a_key_ends_has_a_shortest_length(age_s: float, event: Event) -> None:
    board = Keyboard()
    board.marks.begin(np.zeros(1, np.intp))
    board.now += age_s
    board.marks.on_key(b"s")
    assert board.frame() == event
    assert ("at least 0.5 s" in board.answers[0]) == (event == Event.NOTHING)


def test_every_key_is_answered_in_every_state() -> None:
    for key in b"sfirpx":
        for state in ("take", "waiting", "closed"):
            board = Keyboard()
            if state == "closed":
                board.marks.close("the robot starts")
            with board.marks.waiting(has_last=True) if state == "waiting" else contextlib.nullcontext():
                board.marks.on_key(bytes([key]))
            assert len(board.answers) == 1, (chr(key), state)
            assert board.answers[0].startswith(chr(key))
            counts = state == "take" or (state == "waiting" and key in b"rp")
            assert ("counts for nothing" in board.answers[0]) == (not counts and key != ord("x"))
            ends = {ord("s"): Event.SUCCESS, ord("f"): Event.FAILURE} if counts else {}
            assert board.frame() == ends.get(key, Event.NOTHING)
            if state == "closed":
                assert board.answers[0].endswith("the robot starts") or key == ord("x")
                assert not board.marks.is_paused


def test_a_pause_is_not_ended_by_its_own_key() -> None:
    board = Keyboard()
    board.marks.on_key(b"p")
    with board.marks.waiting() as is_pressed:
        for _ in range(3):
            board.now += 1.0
            board.marks.on_key(b"p")
            assert board.marks.is_paused
        assert not is_pressed()
    assert not board.marks.is_paused


def test_wrong_names_are_refused() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'success'"):
        Marks().outcome("sucess")
    with pytest.raises(ConfigError, match="no simulation 1; valid: 0 to 0"):
        Marks().intervention(simulation=1)
    for name in OUTCOMES:
        Marks().outcome(name)


def test_an_outcome_that_the_task_cannot_have_is_refused() -> None:
    simulation = make_simulation(TurtleBot3Config(beams=36), 1)
    loop = EpisodeLoop(simulation, make_task(AvoidConfig(), 1, 10), GapFollowerBrain(GapFollowerConfig()))
    with pytest.raises(ConfigError, match="dropped"):
        loop.marks.outcome("dropped")
    loop.marks.outcome("stuck")


def run(say: dict[tuple[int, int], Any], episodes: int = 3) -> list[Episode]:
    """Run episodes of two simulations and call a mark when a simulation has done so many frames."""
    simulation = make_simulation(TurtleBot3Config(beams=36), 2)
    task = make_task(AvoidConfig(duration_s=2.0), 2, 10)
    loop = EpisodeLoop(simulation, task, GapFollowerBrain(GapFollowerConfig()))
    done = [0, 0]

    def observe(sim: int, values: dict[str, Any]) -> None:
        done[sim] += 1
        if (sim, done[sim]) in say:
            say[sim, done[sim]](loop.marks)

    loop.observer = observe
    return list(loop.run([EpisodeSpec(i, 2 * i) for i in range(episodes)]))


def test_in_the_loop_an_outcome_ends_its_episode_and_no_other() -> None:
    plain = run({})
    marked = run({(1, 5): lambda marks: marks.outcome("success", 1)})
    assert [len(one.columns[keys.EVENT]) for one in plain] == [20, 20, 20]
    assert [len(one.columns[keys.EVENT]) for one in marked] == [20, 6, 20]
    assert (marked[1].outcome.success, marked[1].outcome.event) == (True, Event.SUCCESS)
    assert marked[1].columns[keys.SUCCESS].tolist() == [False] * 5 + [True]
    assert marked[1].columns[keys.EVENT].tolist() == [0] * 5 + [Event.SUCCESS]
    assert marked[1].columns[keys.DONE].tolist() == [False] * 5 + [True]
    for key, column in plain[1].columns.items():
        if key not in (keys.EVENT, keys.SUCCESS, keys.DONE, keys.REWARD):
            np.testing.assert_array_equal(marked[1].columns[key], column[:6], err_msg=key)
    assert marked[0].outcome == plain[0].outcome
