"""Episodes in which somebody takes over: what is flagged, what is recorded, and that nothing else changes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.loader.check import fingerprint
from bhd_lerobot.datasets.loader.loader import LoaderConfig, make_loader
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.policies.baselines import NoopConfig, RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.policies.dagger.brain import DaggerConfig
from bhd_lerobot.policies.manipulation.servo import PickServoConfig
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerConfig
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.rollout.drivers import DriverLog, Intervention, flagged
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.replay.simulated import Replay
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.task import Event
from tests.recording.support import data_columns, episode_rows, run_record, save_lidar_policy

SECONDS = 2.0
NOBODY: dict[str, Any] = {"collision_s": None, "stall_s": None}


def run(kind: str, brain: Any, n: int = 2, episodes: int = 3, seconds: float = SECONDS) -> list[Episode]:
    if kind == "ur5":
        simulation = make_simulation(UR5Config(action_space="tool", tool_pose=True), n)
        task = make_task(ReachConfig(duration_s=seconds), n, 25)
    else:
        simulation = make_simulation(TurtleBot3Config(beams=36), n)
        task = make_task(AvoidConfig(duration_s=seconds), n, 10)
    return list(EpisodeLoop(simulation, task, brain).run([EpisodeSpec(i, 2 * i) for i in range(episodes)]))


def assert_same(first: Episode, second: Episode, but: tuple[str, ...] = ()) -> None:
    for key, column in first.columns.items():
        if key not in but:
            np.testing.assert_array_equal(second.columns[key], column, err_msg=key)


def test_a_learner_that_nobody_corrects_drives_as_if_alone() -> None:
    random = RandomConfig(scale=0.1)
    dagger = make_brain(DaggerConfig(random, GapFollowerConfig(), **NOBODY))
    alone, together = run("turtlebot3", RandomBrain(random)), run("turtlebot3", dagger)
    for first, second in zip(alone, together, strict=True):
        assert_same(first, second)
        assert first.interventions is None
        assert second.interventions == []
        assert (second.columns[keys.EVENT] != Event.INTERVENTION).all()


def test_exactly_the_frames_that_the_expert_drove_are_flagged_and_its_actions_are_recorded() -> None:
    settings = DaggerConfig(NoopConfig(), GapFollowerConfig(), **{**NOBODY, "patience_s": 0.5, "hold_s": 0.3})
    for episode in run("turtlebot3", make_brain(settings)):
        event, action = episode.columns[keys.EVENT], episode.columns[keys.ACTION]
        flags = (np.arange(20) % 8) >= 5
        flags[-1] = False  # the end of an episode says more
        assert (event == Event.INTERVENTION).tolist() == flags.tolist()
        assert event[-1] == episode.outcome.event != Event.INTERVENTION
        assert (action[~flags] == 0).all()
        assert (np.abs(action[flags]).max(axis=1) > 0).all()
        assert episode.interventions is not None
        assert [(intervention.first, intervention.end) for intervention in episode.interventions] == [(5, 8), (13, 16)]
        assert {intervention.cause for intervention in episode.interventions} == {"time is up"}
        assert episode.commands is None


AVOID = {"brain__type": "dagger", "brain__learner__type": "random", "brain__expert__type": "gap_follower"}
TURNS = {"brain__patience_s": 1, "brain__hold_s": 1}
ARM = {"robot__type": "ur5", "robot__beams": None, "robot__action_space": "tool", "robot__tool_pose": True}
REACH = {
    **ARM,
    "task__type": "reach",
    "brain__type": "dagger",
    "brain__learner__type": "noop",
    "brain__expert__type": "reach_servo",
    "brain__patience_s": 0.4,
    "brain__hold_s": 1.0,
}


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("robot", [{**AVOID, **TURNS}, REACH], ids=["avoid", "reach"])
def test_the_dataset_is_the_same_for_any_number_of_simulations_and_replays_bit_exactly(tmp_path, robot):
    one, many = tmp_path / "one", tmp_path / "many"
    run_record(one, **robot)
    run_record(many, **robot, n_envs=8)
    assert data_columns(one) == data_columns(many)
    assert episode_rows(one) == episode_rows(many)
    columns, rows = data_columns(one), episode_rows(one)
    for index, row in enumerate(rows):
        mine = np.array(columns["episode_index"]) == index
        found = json.loads(row["bhd/interventions"])
        assert found
        assert row["bhd/intervened_frames"] == sum(end - first for first, end, _ in found)
        event = np.array(columns["event"])[mine]
        wanted = np.zeros(len(event), np.bool_)
        for first, end, cause in found:
            wanted[first:end] = True
            assert cause in {"time is up", "no progress", "about to collide"}
        wanted[-1] = False
        assert ((event == Event.INTERVENTION) == wanted).all()
        brain = json.loads(row["bhd/brain"])
        assert (brain["type"], brain["learner"]["type"]) == ("dagger", robot["brain__learner__type"])
        assert Replay(one, index).open_loop().identical


def test_a_pick_that_the_learner_does_not_even_begin_succeeds() -> None:
    simulation = make_simulation(UR5Config(action_space="tool", tool_pose=True), 1)
    brain = make_brain(DaggerConfig(NoopConfig(), PickServoConfig(), collision_s=None, stall_s=0.5))
    (episode,) = EpisodeLoop(simulation, make_task(PickConfig(), 1, 25), brain).run([EpisodeSpec(0, 0)])
    assert episode.outcome.success
    assert episode.interventions is not None
    assert [intervention.cause for intervention in episode.interventions] == ["no progress"]


class Stub(Brain):
    """Says who drives."""

    def __init__(self) -> None:
        self.taken = np.zeros(1, np.bool_)

    def interventions(self) -> np.ndarray:
        return self.taken

    def causes(self) -> list[str]:
        return ["late"]


def test_frames_that_went_by_while_the_brain_thought_belong_to_who_drove_before() -> None:
    stub = Stub()
    log = DriverLog(stub, 1)
    first, length = np.zeros(1, np.intp), np.zeros(1, np.int64)
    log.start(first)
    log.decided()
    log.frame(first, length, is_missed=False)
    stub.taken[:] = True
    log.decided()
    for frame, is_missed in ((1, True), (2, True), (3, False)):
        assert log.frame(first, length + frame, is_missed=is_missed).tolist() == [not is_missed]
    (only,) = log.interventions(0) or []
    assert (only.first, only.end, only.cause) == (3, 4, "late")


def test_frames_that_went_by_before_the_first_decision_belong_to_the_first() -> None:
    stub = Stub()
    stub.taken[:] = True
    log = DriverLog(stub, 1)
    log.start(np.zeros(1, np.intp))
    log.decided()
    assert log.frame(np.zeros(1, np.intp), np.zeros(1, np.int64), is_missed=True).tolist() == [True]
    assert log.interventions(0) == [Intervention(0, 1, "late")]


def test_what_ends_an_episode_is_not_overwritten() -> None:
    event = np.array([Event.NOTHING, Event.NOTHING, Event.SUCCESS, Event.COLLISION])
    taken = np.array([False, True, True, False])
    assert flagged(event, taken).tolist() == [0, Event.INTERVENTION, Event.SUCCESS, Event.COLLISION]


def test_what_the_expert_would_do_is_recorded_in_every_frame_and_learned_from_in_place_of_what_was_done(tmp_path):
    driven, alone, both = tmp_path / "driven", tmp_path / "alone", tmp_path / "both"
    run_record(driven, **AVOID, brain__patience_s=1, dataset__num_episodes=2, dataset__expert_action=True)
    columns = {key: np.array(values) for key, values in data_columns(driven).items()}
    advice, action = columns["expert.action"], columns["action"]
    by_expert = columns["event"] == int(Event.INTERVENTION)
    assert np.array_equal(advice[by_expert], action[by_expert])
    assert (np.abs(advice - action)[~by_expert].max(axis=1) > 0.01).mean() > 0.5  # the learner knows nothing
    # It is what the expert really does there: with it alone, the first frame of an episode begins alike.
    options = {"brain__type": "gap_follower", "dataset__num_episodes": 2, "dataset__expert_action": True}
    run_record(alone, **{key: value for key, value in AVOID.items() if not key.startswith("brain")}, **options)
    rule = {key: np.array(values) for key, values in data_columns(alone).items()}
    assert np.array_equal(rule["expert.action"], rule["action"])
    assert np.array_equal(rule["action"][rule["frame_index"] == 0], advice[columns["frame_index"] == 0])
    # Together they are one dataset, of which both loaders serve the expert's actions, with their statistics.
    merge([driven, alone], both)
    wanted = np.concatenate([advice, rule["action"]])
    digests = set()
    for budget in (4.0, 1e-9):
        loading = LoaderConfig(
            batch_size=7, expert_action=True, budget_gib=budget, delta_timestamps={"action": [0.0, 0.1]}
        )
        loaders = make_loader("t/t", loading, root=both, report=lambda _: None)
        assert (type(loaders.dataset).__name__ == "LeRobotDataset") == (budget < 1)
        digests.add(fingerprint(loaders.dataset, ["action"]))
        for batch in loaders.train:
            assert np.array_equal(batch["action"][:, 0].numpy(), wanted[batch["index"].numpy()].astype(np.float32))
        stats = loaders.dataset.meta.stats["action"]
        assert np.allclose(stats["mean"], wanted.mean(axis=0), atol=1e-5)
    assert len(digests) == 1


EXPERTS = {
    "navigator": {"task__type": "navigate"},
    "reach_servo": {**ARM, "task__type": "reach"},
    "pick_servo": {**ARM, "task__type": "pick"},
}


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("expert", EXPERTS)
def test_every_rule_that_gives_setpoints_says_what_it_would_do_where_it_did_not_choose_to_be(expert, tmp_path):
    common = {**EXPERTS[expert], "dataset__expert_action": True, "dataset__episode_time_s": 1.6}
    brains = {"brain__type": "dagger", "brain__learner__type": "noop", "brain__expert__type": expert}
    turns = {"brain__patience_s": 0.4, "brain__hold_s": 0.4, "brain__collision_s": None, "brain__stall_s": None}
    turns = {name: "null" if value is None else value for name, value in turns.items()}
    run_record(tmp_path / "driven", **common, **brains, **turns, dataset__num_episodes=2)
    run_record(tmp_path / "alone", **common, brain__type=expert, dataset__num_episodes=2)
    driven, alone = (
        {key: np.array(values) for key, values in data_columns(tmp_path / name).items()} for name in ("driven", "alone")
    )
    by_expert = driven["event"] == int(Event.INTERVENTION)
    assert 0.2 < by_expert.mean() < 0.8
    assert np.array_equal(driven["expert.action"][by_expert], driven["action"][by_expert])
    assert (np.abs(driven["expert.action"] - driven["action"])[~by_expert].max(axis=1) > 0.001).mean() > 0.5
    assert np.array_equal(alone["expert.action"], alone["action"])
    starts = [one["frame_index"] == 0 for one in (alone, driven)]
    assert np.array_equal(alone["action"][starts[0]], driven["expert.action"][starts[1]])


def test_who_is_no_expert_gives_no_advice(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"brain\.expert\.type is 'reach', which gives goals.*use reach_servo"):
        run_record(tmp_path / "goals", **{**REACH, "brain__expert__type": "reach"})
    save_lidar_policy(tmp_path / "policy")
    policy = {"brain__type": "learned", "brain__path": tmp_path / "policy", "dataset__expert_action": True}
    with pytest.raises(ConfigError, match=r"brain\.type is 'learned', a policy, and no expert\. Use a rule"):
        run_record(tmp_path / "policy_alone", **policy)
    with pytest.raises(ConfigError, match=r"brain\.type is 'learned', a policy, and no expert"):
        run_record(tmp_path / "named", **policy, brain__name="mine")
    run_record(tmp_path / "without", **AVOID, brain__patience_s=1, dataset__num_episodes=1)
    with pytest.raises(DatasetError, match=r"has no column 'expert.action'.*--dataset.expert_action=true"):
        make_loader("t/t", LoaderConfig(batch_size=7, expert_action=True), root=tmp_path / "without")
