"""Laws of the gap follower beside those of `test_driving.py`: symmetry, sides, memory, and what it achieves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.differential_base import differential_base
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.navigation.clearance import QUANTUM, ClearanceTable, Footprint, Level, make_paths
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.task import Outcome, episode_seed
from tests.cases import each_case
from tests.policies.navigation import test_driving as driving
from tests.policies.navigation.test_driving import BURGER, inside_box, random_scans, see

BEAMS = (36, 90, 360)


def bound(beams: int, n: int, config: GapFollowerConfig | None = None, body: Any = BURGER) -> GapFollowerBrain:
    return driving.bound(GapFollowerBrain, n, beams, config, body)


def decide(scan: np.ndarray) -> np.ndarray:
    scan = np.atleast_2d(scan)
    return see(bound(scan.shape[1], len(scan)), scan)


@each_case("beams", BEAMS)
def test_it_turns_to_the_free_side(beams: int) -> None:
    open_left = inside_box(beams, front=0.4, back=3.0, left=3.0, right=0.3)
    open_right = inside_box(beams, front=0.4, back=3.0, left=0.3, right=3.0)
    assert decide(open_left)[0, 1] > 0.3
    assert decide(open_right)[0, 1] < -0.3


def test_wedged_in_a_slot_it_backs_off() -> None:
    forward, turn = decide(inside_box(360, front=0.125, back=2.0, left=0.12, right=0.12))[0]
    assert forward < 0
    assert turn == 0


@each_case("beams", [36, 90, 360])
def test_one_lost_beam_does_not_matter_a_lost_quarter_does(beams: int) -> None:
    scan = np.full((2, beams), 3.5)
    scan[0, beams // 4] = np.nan
    scan[1, : beams // 4] = np.nan
    assert decide(scan).tolist() == [[0.22, 0], [0, 0]]


def test_readings_at_the_limits_survive_single_precision() -> None:
    scan = inside_box(360, front=0.12, back=3.5, left=3.5, right=3.5)
    assert np.array_equal(decide(scan), decide(scan.astype(np.float32).astype(np.float64)))


def test_a_measured_twist_that_is_no_number_does_no_lasting_harm() -> None:
    brain, other = bound(90, 1), bound(90, 1)
    scan = random_scans(1, 90, seed=3)
    for twist in ((0.1, 0.2), (np.nan, np.inf), (0.1, 0.2)):
        assert np.isfinite(see(brain, scan, twist)).all()
        see(other, scan, tuple(np.nan_to_num(twist, posinf=0.0)))
    assert np.array_equal(see(brain, scan), see(other, scan))


@pytest.mark.parametrize("side", [-1, 1])
def test_new_ground_attracts(side: int) -> None:
    """Two ways are equally free; the robot takes the one that it did not come from."""
    brain = bound(120, 1, GapFollowerConfig(commit_weight=0.0))
    for _ in range(100):  # 2 m along a way
        see(brain, np.full(120, 3.5), (0.2, 0.0))
    for _ in range(10):  # a quarter turn: the way driven now lies on the side that the robot turned to
        see(brain, np.full(120, 3.5), (0.0, side * np.pi / 2))
    junction = inside_box(120, front=0.45, back=0.5, left=2.5, right=2.5)
    assert see(brain, junction)[0, 1] * side < -0.3


def test_reset_forgets_only_the_given_simulations() -> None:
    scans = random_scans(3, 120, seed=5)
    brain = bound(120, 3)
    for step in range(50):
        see(brain, np.roll(scans, step, axis=1), (0.2, 0.5))
    untouched = bound(120, 3)
    for step in range(50):
        see(untouched, np.roll(scans, step, axis=1), (0.2, 0.5))
    brain.reset(np.array([1]), [7], 3)
    after, before, fresh = see(brain, scans), see(untouched, scans), decide(scans)
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert np.array_equal(after[1], fresh[1])
    brain.reset(np.arange(2), [0, 0], 2)  # another number of robots: everything is new
    assert np.array_equal(see(brain, scans[:2]), fresh[:2])


@each_case(("asked", "speed"), [({}, 0.5), ({"forward_speed": 0.1}, 0.1), ({"rim_speed": 0.3}, 0.3)])
def test_speeds_and_ranges_are_those_of_the_base_where_they_are_not_set(asked: dict[str, float], speed: float) -> None:
    base = differential_base(
        "rover", wheel_radius=0.06, wheel_separation=0.2, size=(0.24, 0.18, 0.08), mass=2.5, max_velocity=(0.5, 2.5)
    )
    body = replace(base, lidar=replace(base.lidar, range_min=0.05, range_max=8.0))
    brain = bound(90, 1, GapFollowerConfig(**asked), body)
    assert brain.parameters()["forward_speed"] == speed
    assert (brain.parameters()["range_min_m"], brain.parameters()["range_max_m"]) == (0.05, 8.0)
    assert see(brain, np.full(90, 8.0))[0] == pytest.approx([speed, 0.0])


def test_what_does_not_fit_the_base_is_refused() -> None:
    for asked in ({"forward_speed": 0.3}, {"range_min_m": 4.0}):
        with pytest.raises(ConfigError, match=rf"brain\.{next(iter(asked))} is {next(iter(asked.values()))}"):
            bound(90, 1, GapFollowerConfig(**asked))


@pytest.mark.parametrize("sectors", [36, 120])
def test_a_mirrored_scan_mirrors_the_room(sectors: int) -> None:
    paths = make_paths(0.22, 0.2272, Footprint.of(BURGER))
    table = ClearanceTable(paths, sectors, 0.01, (Level(0.05, 0.005),), 3.5)
    scan = random_scans(100, sectors, seed=6)
    room = table.clear(table.rows(scan), 0)
    mirrored = table.clear(table.rows(np.roll(scan[:, ::-1], 1, axis=1)), 0)
    two_sided = np.abs(paths.heading) < np.pi - 1e-9  # half a turn is made to the left only
    assert np.array_equal(paths.heading[paths.mirror[two_sided]], -paths.heading[two_sided])
    assert np.array_equal(room[:, two_sided], mirrored[:, paths.mirror[two_sided]])


def test_an_obstacle_on_a_path_is_met_where_the_path_comes_to_it() -> None:
    """Whatever is put on the robot's centre line at some length, no path may go on past it."""
    paths = make_paths(0.22, 0.2272, Footprint.of(BURGER))
    table = ClearanceTable(paths, 360, 0.01, (Level(0.05, 0.005),), 3.5)
    lengths = np.array([0.6, 1.0, 2.0])
    for length, x, y in zip(lengths, *paths.points(lengths), strict=True):
        for path in np.flatnonzero(
            (np.hypot(x - BURGER.lidar.ahead, y) > 0.3) & (np.hypot(x - BURGER.lidar.ahead, y) < 3.4)
        ):
            angle = np.arctan2(y[path], x[path] - BURGER.lidar.ahead)
            scan = np.full((1, 360), 3.5)
            scan[0, round(np.degrees(angle)) % 360] = np.hypot(x[path] - BURGER.lidar.ahead, y[path])
            assert table.clear(table.rows(scan), 0)[0, path] * QUANTUM <= length


def run(brain: Brain, seeds: list[int], n: int, beams: int = 120, seconds: float = 40.0) -> list[Outcome]:
    simulation = Simulation(TurtleBot3Config(beams=beams), n)
    loop = EpisodeLoop(simulation, AvoidTask(AvoidConfig(duration_s=seconds, min_path_m=0.0), n, 10), brain)
    return [e.outcome for e in loop.run([EpisodeSpec(index, seed) for index, seed in enumerate(seeds)])]


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("beams", [36, 360])
def test_it_gets_out_of_a_dead_end(beams: int) -> None:
    """A corridor 0.7 m wide and 1.2 m deep, closed behind the robot's nose."""
    walls = (
        Shape("box", 1.6, 0.0, 0.0, 0.03, 0.41),
        Shape("box", 1.0, 0.38, 0.0, 0.6, 0.03),
        Shape("box", 1.0, -0.38, 0.0, 0.6, 0.03),
        *(Shape("box", side * 2.05, 0.0, 0.0, 0.05, 2.1) for side in (-1, 1)),
        *(Shape("box", 0.0, side * 2.05, 0.0, 2.1, 0.05) for side in (-1, 1)),
    )
    starts = [(1.3, 0.0, 0.0), (1.1, 0.1, 0.3), (1.1, -0.12, -0.5)]
    arenas = [Arena("dead end", walls, (-2.0, 2.0, -2.0, 2.0), start) for start in starts]
    ids = np.arange(len(starts))
    simulation = Simulation(TurtleBot3Config(beams=beams), len(ids))
    brain = GapFollowerBrain()
    brain.bind(RobotFeatures(simulation.observation_names, simulation.action_names, 10, body=BURGER))
    simulation.reset(ids, arenas, [1, 2, 3])
    brain.reset(ids, [1, 2, 3], len(ids))
    outside = np.zeros(len(ids), np.bool_)
    for _ in range(200):
        simulation.step(brain.act(Observation(simulation.observation_names, simulation.observe().state)))
        assert not simulation.truth().touched.any()
        outside |= simulation.world.base_pose[:, 0] < 0.2
    assert outside.all()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("beams", [36, 180])
def test_it_roams_without_contact_with_any_scanner(beams: int) -> None:
    outcomes = run(GapFollowerBrain(), [episode_seed(5, e, "train") for e in range(2)], 2, beams, seconds=25)
    assert all(outcome.success for outcome in outcomes)
    assert all(outcome.details["path_m"] > 4 for outcome in outcomes)
