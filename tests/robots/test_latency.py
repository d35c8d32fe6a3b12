"""A plant that gets its commands late: by exactly so many ticks, each simulation by its own."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.latency import MAX_LATENCY, LatePlant

ARM = ur5()


class Plant:
    """Keeps what is written, and reads what a test wants."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.rows: list[np.ndarray] = []
        self.position = 0.0

    def read(self, out: PlantReading) -> None:
        out.position[:] = self.position

    def write(self, ctrl: np.ndarray) -> None:
        self.rows.append(ctrl.copy())


class Line:
    """A late plant, written a new number each tick, the same for all simulations."""

    def __init__(self, latency: list[int]) -> None:
        self.n = len(latency)
        self.plant = Plant(self.n)
        self.late = LatePlant(self.plant, ARM)  # type: ignore[arg-type]
        self.late.set_latency(np.arange(self.n), latency)
        self.tick = 0

    def write(self, ticks: int) -> None:
        for _ in range(ticks):
            self.late.write(np.full((self.n, 7), float(self.tick)))
            self.tick += 1

    def arrived(self, sim: int) -> list[float]:
        rows = np.array(self.plant.rows)[:, sim]
        assert (rows == rows[:, :1]).all()
        return rows[:, 0].tolist()


@given(st.lists(st.integers(0, MAX_LATENCY), min_size=1, max_size=5))
def test_each_command_arrives_exactly_so_many_ticks_late_and_the_first_holds_until_then(latency: list[int]) -> None:
    line = Line(latency)
    line.write(80)
    for sim, late in enumerate(latency):
        assert line.arrived(sim) == [float(max(0, tick - late)) for tick in range(80)]


def test_delayed_commands_do_not_cross_episodes() -> None:
    line = Line([5, 3])
    line.write(40)
    line.late.set_latency(np.array([0]), [7])
    line.write(40)
    assert line.arrived(0)[40:] == [float(max(40, tick - 7)) for tick in range(40, 80)]
    assert line.arrived(1) == [float(max(0, tick - 3)) for tick in range(80)]  # and the neighbour notices nothing


@pytest.mark.parametrize("change", [([0], [4]), ([1], [0]), ([0, 1], [0, 0]), ([0, 1], [25, 1])])
def test_switching_on_and_off_is_between_two_ticks(change: tuple[list[int], list[int]]) -> None:
    sims, latency = change
    line = Line([0, 6])
    line.write(30)
    line.late.set_latency(np.array(sims), latency)
    line.write(60)
    for sim, late in zip(sims, latency, strict=True):
        assert line.arrived(sim)[30:] == [float(max(30, tick - late)) for tick in range(30, 90)]


def test_the_command_may_be_the_same_array_every_time() -> None:
    line = Line([2])
    ctrl = np.zeros((1, 7))
    for tick in range(10):
        ctrl[:] = tick
        line.late.write(ctrl)
    assert line.arrived(0) == [0, 0, 0, 1, 2, 3, 4, 5, 6, 7]


def test_readings_are_not_late() -> None:
    line = Line([20])
    out = PlantReading(1, 7)
    for tick in range(5):
        line.plant.position = float(tick)
        line.late.read(out)
        assert (out.position == tick).all()
        line.write(1)


@pytest.mark.parametrize("ticks", [-1, MAX_LATENCY + 1, 10**9])
def test_invalid_latencies_are_refused(ticks: int) -> None:
    line = Line([3, 3])
    with pytest.raises(ConfigError, match=f"latency_ticks is {ticks}; it must be between 0 and {MAX_LATENCY}"):
        line.late.set_latency(np.array([0, 1]), [1, ticks])
    line.write(20)
    assert line.arrived(0) == line.arrived(1) == [float(max(0, tick - 3)) for tick in range(20)]
