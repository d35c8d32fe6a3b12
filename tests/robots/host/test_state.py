"""What a robot publishes at every tick, on a virtual clock: the recorder sees what a lockstep run would have seen."""

import itertools

import numpy as np
import pytest

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.realtime.grid import TickGrid
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.host.state import LIMITS, StatePublisher, published_dtype, raised
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.robots.ur import UR5

F = 20  # ticks in a frame, of both robots


class Rig:
    """A robot whose ticks are published; time is a number."""

    def __init__(self, kind: str) -> None:
        robot = UR5(UR5Config(scene="pick")) if kind == "ur5" else TurtleBot3(TurtleBot3Config())
        self.simulation: Simulation = robot.make_simulation()
        self.simulation.reset(np.zeros(1, np.intp), [robot.make_scene()], [3])
        self.period = 1_000_000_000 // self.simulation.rates.control_hz
        self.now = 10**12
        self.grid = TickGrid(self.now, self.period)
        self.ring = StateRing(published_dtype(self.simulation), 512)
        self.publisher = StatePublisher(self.simulation, self.ring, lambda: self.now)
        self.publisher.restart(1)
        before = self.grid.begin(self.now)  # an idle tick, to have a slot with the number -1
        self.publisher.publish(type(before)(-1, self.now - self.period, 0, 0), 0, 0, TickGrid(self.now, self.period))
        self.grid = TickGrid(self.now, self.period)

    def tick(self, late_ns: int = 0) -> None:
        self.now = max(self.now, self.grid.next_due_ns) + late_ns
        slot = self.grid.begin(self.now)
        self.simulation.run_tick(slot.due_ns - self.grid.start_ns, 1 + slot.skipped)
        self.now += 100_000
        self.publisher.publish(slot, self.now - 100_000, self.now, self.grid)
        self.grid.end(self.now)

    def latest(self) -> np.ndarray:
        state = self.ring.latest()
        assert state is not None
        return state


@pytest.fixture(params=["turtlebot3", "ur5"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(request.param)


def test_published_states_match_the_simulation_from_before_the_first_tick_on(rig: Rig) -> None:
    state = rig.latest()
    assert int(state["sensed_ns"]) == rig.grid.start_ns - rig.period
    assert state["state"]["mode"] == Mode.HOLD
    for executed in (0, 45):
        for _ in range(executed):
            rig.tick()
        state = rig.latest()
        assert (int(state["tick"]), int(state["executed"]), int(state["skipped"])) == (executed - 1, executed, 0)
        np.testing.assert_array_equal(state["observation"], rig.simulation.observe().state)
        np.testing.assert_array_equal(state["physics"], rig.simulation.physics_state)
    assert state["state"].tobytes() == rig.simulation.cerebellum.states[0].tobytes()


def test_age_counts_from_the_oldest_reading(rig: Rig) -> None:
    ages = []
    for _ in range(90):
        rig.tick()
        ages.append(int(rig.latest()["oldest_ns"]))
    period = rig.simulation.sensor_period_s  # of the lidar, 0.2 s; an arm reads all of its sensors at every tick
    assert max(ages) == max(0, round(period * 1e9) - rig.period)
    assert min(ages) == 0


def test_a_limit_is_in_the_state_that_its_frame_ends_with() -> None:
    rig = Rig("turtlebot3")
    boundaries = [rig.latest()]
    for tick in range(4 * F):
        if tick == F + 3:  # within the second frame
            values = np.array([[5.0, 0.0]])  # far too fast
            rig.simulation.bridge.send(values, due_ns=tick * rig.period)
        rig.tick()
        if (tick + 1) % F == 0:
            boundaries.append(rig.latest())
    flags = [raised(before, after)[0] for before, after in itertools.pairwise(boundaries)]
    assert flags[0] == 0
    assert flags[1] & Limit.VELOCITY
    assert flags[1] & Limit.ACCELERATION
    assert set(LIMITS) == set(Limit) - {Limit.NONE}
    np.testing.assert_array_equal(boundaries[-1]["state"]["requested"][:2], values[0])
    assert int(boundaries[1]["state"]["setpoints_taken"]) == 0
    assert int(boundaries[2]["state"]["setpoints_taken"]) == 1


def test_a_watchdog_is_in_the_state_that_its_frame_ends_with_also_if_the_last_tick_was_skipped() -> None:
    rig = Rig("turtlebot3")
    rig.simulation.bridge.send(np.array([[0.1, 0.0]]), due_ns=0)
    boundaries, frame = [rig.latest()], 0
    for tick in range(200):
        rig.tick(late_ns=3 * rig.period if tick in (17, 40, 110) else 0)
        state = rig.latest()
        if (int(state["tick"]) + 1) // F > frame:
            frame = (int(state["tick"]) + 1) // F
            boundaries.append(state)
    watched = [raised(before, after)[1] for before, after in itertools.pairwise(boundaries)]
    # The command is too old after 0.5 s: 100 ticks, in the sixth frame.
    assert [bool(flags & Watchdog.COMMAND_AGE) for flags in watched].index(True) == 5
    assert sum(bool(flags & Watchdog.COMMAND_AGE) for flags in watched) == 1
    assert int(boundaries[-1]["skipped"]) == 9
