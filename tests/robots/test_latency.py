"""A plant that gets its commands late: by exactly so many ticks, each simulation by its own."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import Body, Shape
from bhd_lerobot.bodies.tabletop import TableScene, Variation
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.commands import BrainCommand, Goals, ResultCode
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.parts.latency import MAX_LATENCY, LatePlant
from tests.cases import each_case

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
    """A late plant, written a new number each tick, the same for all simulations and in the same array."""

    def __init__(self, latency: list[int]) -> None:
        self.n = len(latency)
        self.plant = Plant(self.n)
        self.late = LatePlant(self.plant, 7)  # type: ignore[arg-type]
        self.late.set_latency(np.arange(self.n), latency)
        self.tick = 0
        self._ctrl, self._reading = np.zeros((self.n, 7)), PlantReading(self.n, 7)

    def write(self, ticks: int) -> None:
        for _ in range(ticks):
            self._ctrl[:] = self.plant.position = float(self.tick)
            self.late.write(self._ctrl)
            self.late.read(self._reading)
            assert (self._reading.position == self.tick).all()  # readings are not late
            self.tick += 1

    def arrived(self, sim: int) -> list[float]:
        rows = np.array(self.plant.rows)[:, sim]
        assert (rows == rows[:, :1]).all()
        return rows[:, 0].tolist()


@given(
    st.lists(st.integers(0, MAX_LATENCY), min_size=3, max_size=3),
    st.lists(st.tuples(st.integers(1, 60), st.integers(0, 2), st.integers(0, MAX_LATENCY)), max_size=4),
)
def test_each_command_arrives_so_many_ticks_late_and_the_first_of_an_episode_holds_until_then(
    latency: list[int], episodes: list[tuple[int, int, int]]
) -> None:
    """Whatever the latency was before, and whatever the neighbours' are."""
    line, begun, expected = Line(latency), [0, 0, 0], [[], [], []]

    def write(ticks: int) -> None:
        for tick in range(line.tick, line.tick + ticks):
            for sim in range(3):
                expected[sim].append(float(max(begun[sim], tick - latency[sim])))
        line.write(ticks)

    for ticks, sim, late in episodes:
        write(ticks)
        line.late.set_latency(np.array([sim]), [late])
        begun[sim], latency[sim] = line.tick, late
    write(80)
    assert [line.arrived(sim) for sim in range(3)] == expected


@each_case("ticks", [-1, MAX_LATENCY + 1, 10**9])
def test_invalid_latencies_are_refused(ticks: int) -> None:
    line = Line([3, 3])
    with pytest.raises(ConfigError, match=f"latency_ticks is {ticks}; it must be between 0 and {MAX_LATENCY}"):
        line.late.set_latency(np.array([0, 1]), [1, ticks])
    line.write(20)
    assert line.arrived(0) == line.arrived(1) == [float(max(0, tick - 3)) for tick in range(20)]


SIMS = 4
SPREAD = np.array([2.5, 0.2, 0.5, 1.5, 1.5, 2.5])  # [rad] of targets beside home, clear of the table


class Declared(UR5Config):
    """A UR5 whose body says how late its servos are; the others' is the disturbance of a scene."""

    latency_s = 0.0

    def body(self) -> Body:
        body = super().body()
        return dataclasses.replace(body, arm=dataclasses.replace(body.arm, latency_s=self.latency_s))


def late_arms(latency: float, declared: bool, n: int = SIMS, **options: Any) -> Simulation:
    config = Declared(max_force=float("inf"))
    config.latency_s = latency if declared else 0.0
    arms = Simulation(config, n, threads=1, **options)
    scene = TableScene("empty", (), arms.body.arm.home, variation=Variation(latency_s=latency))
    arms.reset(np.arange(n), [scene] * n, range(n))
    return arms


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("declared", [False, True])
def test_late_servos_follow_far_setpoints_and_goals_without_a_protective_stop(declared: bool) -> None:
    arms, random = late_arms(0.05, declared), np.random.default_rng(0)
    home = np.array(arms.body.arm.home)
    target = np.tile(home, (SIMS, 1))
    for frame in range(80):
        if frame % 10 == 0:
            target[:, :6] = home[:6] + random.uniform(-1, 1, (SIMS, 6)) * SPREAD
        report = arms.step(target)
        assert not report.watchdog.any(), [Watchdog(int(flags)) for flags in report.watchdog]
    codes = []
    for number in range(3):
        postures = home[:6] + random.uniform(-1, 1, (SIMS, 6)) * SPREAD
        goals = {sim: [BrainCommand(f"{number}", joint_target=tuple(postures[sim]))] for sim in range(SIMS)}
        command: Goals | None = Goals(goals)
        for _ in range(80):
            report = arms.step(command)
            command = None
            codes += [result.code for results in report.results.values() for result in results]
    assert len(codes) == 3 * SIMS
    assert set(codes) <= {ResultCode.SUCCEEDED, ResultCode.SELF_COLLISION}
    assert codes.count(ResultCode.SUCCEEDED) > SIMS
    arms.close()


@pytest.mark.parametrize("by_goal", [False, True])
@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_a_late_arm_that_something_is_in_the_way_of_is_stopped(latency: float, by_goal: bool) -> None:
    arms = late_arms(latency, False, 1, fixtures=(Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8),))
    action = arms.cerebellum.command.copy()
    turned = (*(action[0, :1] + 1.6), *action[0, 1:6])
    command: Any = Goals({0: [BrainCommand("a", joint_target=turned, max_velocity=0.3)]}) if by_goal else None
    seen, codes = 0, []
    for _ in range(150):
        action[0, 0] += 0.3 / arms.rates.fps
        report = arms.step(command if by_goal else action)
        command = None
        seen |= int(report.watchdog[0])
        codes += [result.code for results in report.results.values() for result in results]
        if arms.cerebellum.mode[0] == Mode.FAULT:
            break
    assert codes == [ResultCode.PATH_TOLERANCE] if by_goal else seen == Watchdog.BLOCKED
    arms.close()
