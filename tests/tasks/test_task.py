"""What holds of every task: its episodes follow from seeds, and none depends on another."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import ARENAS
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, TableScene
from bhd_lerobot.bodies.truth import ArmTruth, BaseTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.registry import make_task
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.navigate import NavigateConfig
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.task import SPLITS, Event, TaskConfig, episode_seed
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case
from tests.tasks import test_pick as pick
from tests.tasks import test_reach as reach
from tests.tasks.support import Judged

WILD = RandomisationConfig(enabled=True)
# A configuration, and in what its scenes of different seeds differ.
SCENES: list[tuple[TaskConfig, tuple[str, ...]]] = [
    *((AvoidConfig(arena=arena), ("shapes",) if arena == "random" else ()) for arena in ARENAS),
    *((AvoidConfig(arena=arena, random_start=True), ("start",)) for arena in ARENAS),
    *((NavigateConfig(arena=arena), ("goal",)) for arena in ARENAS),
    (PickConfig(), ("objects",)),
    (PickConfig(language="any", randomisation=WILD), ("objects",)),
    (ReachConfig(), ("target_pose", "posture")),
]


@each_case(("config", "differing"), SCENES)
def test_equal_seeds_give_equal_episodes_and_others_others(config: TaskConfig, differing: tuple[str, ...]) -> None:
    one, other = make_task(config, 1, 10), make_task(config, 3, 25)
    for seed in (0, 1, 2**62 + 1):
        scene, next_one = one.sample(seed), one.sample(seed + 1)
        assert scene == other.sample(seed)
        assert (scene == next_one) == (not differing)
        assert all(getattr(scene, name) != getattr(next_one, name) for name in differing)


class _Moving:
    """Truth of a robot that moves at random."""

    def __init__(self, scene: Any, seed: int) -> None:
        self.scene, self.rng = scene, np.random.default_rng(seed)
        self.pose = np.array(getattr(scene, "start", None) or (0.0, 0.0, 0.0))

    def frame(self) -> BaseTruth | ArmTruth:
        if hasattr(self.scene, "start"):
            self.pose = self.pose + self.rng.normal(0, 0.04, 3) * self.rng.integers(2)
            return BaseTruth(self.pose[None].copy(), self.rng.random(1) < 0.02)
        tool = np.array([self.scene.target_pose or (0.5, 0.1, 0.3, 0.0, 1.0, 0.0, 0.0)])
        tool[:, 0] += 0.2 * (self.rng.random() < 0.3)
        poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (1, MAX_OBJECTS, 1))
        for number, one in enumerate(self.scene.objects):
            lift = 0.12 * (number == self.scene.target_object and self.rng.random() < 0.8)
            yaw = (math.cos(one.yaw / 2), 0, 0, math.sin(one.yaw / 2))
            poses[0, number] = (one.x, one.y, one.height / 2 + lift, *yaw)
        touches = self.rng.random((3, 1)) < 0.02
        return ArmTruth(tool, poses, np.zeros(1), *touches, np.ones((1, MAX_OBJECTS), np.bool_))


def _together(truths: list[Any]) -> Any:
    fields = zip(*(vars(one).values() for one in truths), strict=True)
    return type(truths[0])(*map(np.concatenate, fields))


@pytest.mark.law
@each_case(
    "config",
    [
        AvoidConfig(duration_s=5.0, min_path_m=0.5, stuck_time_s=2.0),
        NavigateConfig(duration_s=4.0, stuck_time_s=2.0),
        PickConfig(hold_s=0.3),
        ReachConfig(hold_s=0.3),
    ],
)
def test_an_episode_does_not_depend_on_those_beside_and_before_it(config: TaskConfig) -> None:
    scenes = [make_task(config, 1, 10).sample(seed) for seed in range(4)]
    together = Judged(make_task(config, 4, 10), scenes)
    alone = [Judged(make_task(config, 1, 10), [scene]) for scene in scenes]
    moving = [_Moving(scene, sim) for sim, scene in enumerate(scenes)]
    for frame in range(60):
        if frame == 25:
            together.task.begin(np.array([0]), scenes[1:2])
            together.running[0], together.events[0] = True, Event.NOTHING
            alone[0], moving[0] = Judged(make_task(config, 1, 10), scenes[1:2]), _Moving(scenes[1], 7)
        truths = [one.frame() for one in moving]
        reward = together.judge(_together(truths))
        assert [one.judge(truth)[0] for one, truth in zip(alone, truths, strict=True)] == reward.tolist()
    assert together.events.any()
    assert together.events.tolist() == [one.events[0] for one in alone]
    assert [together.outcome(sim) for sim in range(4)] == [one.outcome() for one in alone]


def test_training_and_held_out_seeds_never_meet() -> None:
    rng = np.random.default_rng(0)
    pairs = [(int(a), int(b)) for a, b in rng.integers(0, 2**31, (4000, 2))]
    pairs += [(seed, episode) for seed in range(60) for episode in range(100)]
    train = [episode_seed(seed, episode, "train") for seed, episode in pairs]
    held_out = [episode_seed(seed, episode, "held_out") for seed, episode in pairs]
    assert len(pairs) == 10_000
    assert {seed % 2 for seed in train} == {0}
    assert {seed % 2 for seed in held_out} == {1}
    assert min(train + held_out) >= 0
    assert max(train + held_out) < 2**63
    assert len(set(train)) == len(set(held_out)) == len(pairs)


def test_seeds_fit_the_columns_of_a_dataset_and_do_not_change() -> None:
    """A dataset names its seeds, and a resumed run continues with them: a change breaks both."""
    assert [episode_seed(1, episode, "train") for episode in range(2)] == [3717377837946358014, 38901565946305238]
    assert np.int64(episode_seed(2**62, 2**31, "held_out")) > 0
    assert episode_seed(0, 0, "held_out") == episode_seed(0, 0, "train") + 1


def test_episodes_to_choose_by_are_none_of_those_that_are_learned_from_or_reported() -> None:
    """Also where an environment has gone on to from the first ones, 2**32 further each time."""
    far = [(k * 2**32 + seed, j * 2**32 + i) for seed in range(3) for i in range(3) for j in range(3) for k in range(3)]
    pairs = {*((seed, i) for seed in range(20) for i in range(200)), *far}
    sets = {split: {episode_seed(*pair, split) for pair in pairs} for split in SPLITS}
    assert all(len(one) >= 4000 for one in sets.values())
    assert not sets["validation"] & (sets["train"] | sets["held_out"])
    assert all(seed % 2 == 0 for seed in sets["train"])
    assert all(seed % 2 for seed in sets["validation"] | sets["held_out"])


@each_case(
    ("arguments", "message"), [((-1, 0, "train"), "-1"), ((0, -1, "train"), "-1"), ((0, 0, "test"), "train, held_out")]
)
def test_seeds_that_cannot_be_are_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        episode_seed(*arguments)


class Held(NamedTuple):
    """A task of which something has to be held for a time, and frames in which it is, just is, and is not."""

    run: Any
    config: Any
    good: dict[str, Any]
    just: dict[str, Any]
    bad: dict[str, Any]
    breaks: list[dict[str, Any]]


HELD = {
    "reach": Held(
        *(reach.Run, ReachConfig, {"away": 0.001}, {"away": 0.0049, "degrees": 1.99}, {"away": 0.2}),
        [{"away": 0.0051}, {"degrees": 2.01}, {"away": 0.0051, "degrees": 2.01}],
    ),
    "pick": Held(
        *(pick.Run, PickConfig, {"lift": 0.11}, {"lift": 0.101}, {"lift": 0.0}),
        [{"lift": 0.099}, {"lift": 0.11, "gripped": False}],
    ),
}


@pytest.mark.law
@each_case("name", HELD)
def test_success_needs_the_whole_hold_time_which_a_break_starts_anew(name: str) -> None:
    task = HELD[name]
    for pause in ({}, *task.breaks):
        run = task.run(task.config(hold_s=0.5))
        frames = run.task.in_frames(0.5)
        run.frame(**task.bad)
        for _ in range(frames - 1):
            run.frame(**task.good)
            assert run.running[0]
        if pause:
            run.frame(**pause)
            for _ in range(frames - 1):
                run.frame(**task.good)
                assert run.running[0]
        run.frame(**task.just)
        assert run.events[0] == Event.SUCCESS
        assert (run.outcome().success, run.outcome().score) == (True, 1.0)


@each_case("name", HELD)
def test_too_late_is_a_time_out_and_the_last_frame_is_not_too_late(name: str) -> None:
    task = HELD[name]
    run, late = (task.run(task.config(duration_s=2.0, hold_s=0.5)) for _ in range(2))
    last, hold = run.task.in_frames(2.0), run.task.in_frames(0.5)
    for frame in range(1, last + 1):
        run.frame(**(task.good if frame > last - hold else task.bad))
        late.frame(**(task.good if frame > last - hold + 1 else task.bad))
    assert (run.events[0], run.frames[0]) == (Event.SUCCESS, last)
    assert (late.events[0], late.frames[0]) == (Event.TIMEOUT, last)
    assert not late.outcome().success


@pytest.mark.law
@each_case("name", HELD)
@each_case("touch", ["arm_on_table", "self_contact", "arm_on_object"])
@each_case("when", ["at once", "at success", "at the end"])
def test_a_touch_is_a_collision_at_once_even_in_the_last_frame_or_that_of_success(name, touch, when):
    task = HELD[name]
    run = task.run(task.config(duration_s=2.0, hold_s=0.5))
    frames = {"at once": 1, "at success": run.task.in_frames(0.5), "at the end": run.task.in_frames(2.0)}[when]
    for frame in range(1, frames + 1):
        run.frame(**(task.good if when == "at success" else task.bad), **{touch: frame == frames})
    if (name, touch) == ("reach", "arm_on_object"):  # there is none
        assert run.events[0] != Event.COLLISION
        return
    assert (run.events[0], run.frames[0]) == (Event.COLLISION, frames)
    assert not run.outcome().success
    assert run.outcome().score <= 0.9


def test_a_scene_without_what_is_asked_for_is_refused() -> None:
    empty = TableScene("empty", (), reach.SCENE.posture)
    for config, message in ((ReachConfig(), "no target pose"), (PickConfig(), "names no object")):
        with pytest.raises(ConfigError, match=message):
            make_task(config, 1, 10).begin(np.array([0]), [empty])


def test_numbers_that_are_recorded_stay_what_they_are() -> None:
    assert [event.cause for event in Event] == [
        "nothing", "success", "collision", "stuck", "timeout", "intervention", "estop", "wrong_object",
        "dropped", "unreachable", "fault", "failure",
    ]  # fmt: skip
    assert [int(event) for event in Event] == list(range(12))
