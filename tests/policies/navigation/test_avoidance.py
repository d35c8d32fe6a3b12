"""The rule of the articles, decision by decision."""

import numpy as np
import pytest

from bhd_lerobot.options.parse import decode
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain, AvoidanceConfig
from tests.cases import each_case

ACTIONS = ("x.vel", "theta.vel")
AHEAD, LEFT, STOP = (0.2, 0.0), (0.0, 0.5), (0.0, 0.0)


def decide(scan: np.ndarray, config: AvoidanceConfig | None = None) -> np.ndarray:
    scan = np.atleast_2d(scan)
    names = tuple(f"scan_{beam:03d}.pos" for beam in range(scan.shape[1]))
    brain = AvoidanceBrain(config)
    brain.bind(RobotFeatures(names, ACTIONS, 10))
    brain.reset(np.arange(len(scan)), [0] * len(scan), len(scan))
    return brain.act(Observation(names, scan))


def one_reading(degrees: int, distance: float, elsewhere: float = 3.5) -> np.ndarray:
    scan = np.full(360, elsewhere)
    scan[degrees % 360] = distance
    return scan


@each_case(
    ("degrees", "expected"), [(-90, AHEAD), (-31, AHEAD), (-30, LEFT), (0, LEFT), (30, LEFT), (31, AHEAD), (180, AHEAD)]
)
def test_the_edges_belong_to_the_sector(degrees: int, expected: tuple[float, float]) -> None:
    assert tuple(decide(one_reading(degrees, 0.49))[0]) == expected


@pytest.mark.law
@each_case(
    ("distance", "expected"),
    [
        (np.nextafter(0.5, 0), LEFT),
        (0.5, AHEAD),
        (np.nextafter(0.5, 1), AHEAD),
        (0.12, LEFT),
        (0.1199, AHEAD),  # not valid, so not there
        (0.0, AHEAD),
        (-1.0, AHEAD),
        (3.5, AHEAD),
        (np.nextafter(3.5, 4), AHEAD),
        (np.nan, AHEAD),
        (np.inf, AHEAD),
    ],
)
def test_exactly_the_safe_distance_is_free_and_invalid_readings_are_not_there(distance, expected):
    assert tuple(decide(one_reading(0, distance))[0]) == expected


@each_case("blind", [np.nan, np.inf, -np.inf, 0.0, 0.11, 3.6])
def test_without_a_valid_reading_in_front_it_stops(blind: float) -> None:
    scan = np.full(360, blind)
    assert tuple(decide(scan)[0]) == STOP
    scan[31:330] = 1.0  # what is behind does not help
    assert tuple(decide(scan)[0]) == STOP
    scan[330] = 1.0  # one valid reading in front is enough
    assert tuple(decide(scan)[0]) == AHEAD


@each_case("beams", [1, 4, 12, 36, 90, 360])
def test_any_number_of_beams(beams: int) -> None:
    scan = np.full(beams, 3.5)
    assert tuple(decide(scan)[0]) == AHEAD
    scan[0] = 0.2
    assert tuple(decide(scan)[0]) == LEFT


def test_parameters_are_used_under_the_names_of_the_articles_nodes_too() -> None:
    config = AvoidanceConfig(front_sector_deg=90, safe_distance_m=1.0, forward_speed=0.1, turn_speed=-0.7)
    given = {"front_sector_deg": 90, "safe_distance": 1.0, "linear_speed": 0.1, "angular_speed": -0.7}
    assert decode(AvoidanceConfig, given, "brain.") == config
    assert tuple(decide(one_reading(90, 0.9), config)[0]) == (0.0, -0.7)
    assert tuple(decide(one_reading(91, 0.9), config)[0]) == (0.1, 0.0)


def test_readings_at_the_limits_are_valid_in_single_precision_too() -> None:
    brain = AvoidanceBrain()
    names = ["x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(36))]
    brain.bind(RobotFeatures(names, ["x.vel", "theta.vel"], 10))
    for reading, expected in ((0.12, [0.0, 0.5]), (3.5, [0.2, 0.0])):
        state = np.full((1, 38), reading, np.float32).astype(np.float64)
        assert brain.act(Observation(tuple(names), state)).tolist() == [expected]
