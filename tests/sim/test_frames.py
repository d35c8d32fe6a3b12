"""Frames in machine code: the bits of ticks and steps in turns, whatever happens between and within them."""

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.control import kernels
from bhd_lerobot.control.commands import BrainCommand, Goals
from bhd_lerobot.control.estop_word import EstopWord
from bhd_lerobot.errors import SimulationError
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim import frames
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case

FRAMES = 30


def count_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that grows with every frame of a share in machine code."""
    calls: list[int] = []
    real = frames._Thread.run
    monkeypatch.setattr(frames._Thread, "run", lambda *arguments: (calls.append(1), real(*arguments))[1])
    return calls


def make(n: int, threads: int | None = None, **options: Any) -> Simulation:
    config = TurtleBot3Config(beams=90, odometry=True, **options)
    simulation = Simulation(config, n, threads)
    arenas = [make_arena("random", sim, robot_radius=0.105) for sim in range(n)]
    simulation.reset(np.arange(n), arenas, list(range(n)))
    return simulation


def tick_alone(simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the ticks of a simulation go by one by one, as on the wall clock."""
    bridge = simulation.bridge

    def advance_ticks(ticks: int) -> None:
        for _ in range(ticks):
            simulation.run_tick(bridge.now_ns, 1)
            bridge._tick += 1

    monkeypatch.setattr(bridge, "advance_ticks", advance_ticks)


KINDS: dict[str, tuple[type, dict[str, Any]]] = {
    "base": (TurtleBot3Config, {"odometry": True}),
    "base that keeps clear": (TurtleBot3Config, {"imu": True, "collision_monitor": True}),
    "base of three steps a tick": (TurtleBot3Config, {"physics_hz": 600}),
    "base that is ticked seldom": (TurtleBot3Config, {"physics_hz": 100, "control_hz": 50}),
    "arm": (UR5Config, {}),
    "arm that tells a wrench, of two steps a tick": (UR5Config, {"wrench": True, "physics_hz": 1000}),
    "arm of little force": (UR5Config, {"max_force": 30.0, "jerk_limits": False}),
    "impedance": (UR5Config, {"control": "impedance", "action_space": "tool"}),
    "arm on a base": (TurtleBot3ManipulationConfig, {"imu": True, "collision_monitor": True, "arena": "random"}),
    "arm from a file": (SO101Config, {}),
    "arm that is ticked seldom": (SO101Config, {"control_hz": 100, "fps": 10, "jerk_limits": False}),
}


def scenes_of(config: Any) -> Callable[[int], Any]:
    """Return what makes a robot's scene of a seed."""
    if isinstance(config, TurtleBot3Config):
        return lambda seed: make_arena("random", seed, robot_radius=0.105)
    if isinstance(config, UR5Config):
        late = RandomisationConfig(enabled=True, latency_s=0.01)
        return PickTask(PickConfig(randomisation=late), 1, config.fps, config.body()).sample
    return lambda _: config.start_scene()


def next_action(config: Any, last: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a base's next twist, or where an arm goes on to from its last action: down, sooner or later."""
    if isinstance(config, TurtleBot3Config):
        return rng.uniform(-1, 1, 2) * (0.3, 3.0)
    by, lean = (0.01, (2, -0.01)) if config.control == "impedance" else (0.06, (1, 0.05))
    change = rng.uniform(-by, by, len(last))
    change[3:] *= config.control != "impedance"  # of a pose: as it is turned, it stays
    change[lean[0]] += lean[1]
    return last + change


def play(
    config: Any, n: int, threads: int | None = None, alone: pytest.MonkeyPatch | None = None
) -> NDArray[np.float64]:
    """Return everything that is observed, reported and true of robots that run into things, stop, and go on.

    The first stops hard, the second is left alone and begins anew, arms that take goals follow one in between.
    """
    robots, scene, ids, rows = Simulation(config, n, threads), scenes_of(config), np.arange(n), []
    if alone is not None:
        tick_alone(robots, alone)
    robots.reset(ids, [scene(sim) for sim in range(n)], ids.tolist())
    rngs = [np.random.default_rng(sim) for sim in range(n)]
    friction, arm = robots.world.model_field("geom_friction"), robots.body.arm
    takes_goals = arm is not None and config.control != "impedance"
    command = robots.cerebellum.command
    action = command.copy()
    for frame in range(FRAMES):
        if frame == 11:
            robots.bridge.estop(ids[:1])
        if frame == 15:
            robots.bridge.reset()
            robots.bridge.activate()
            action[:] = command
        if frame == 17:
            friction[:, :, 0] *= 0.3  # written to between two frames: it counts from the next step on
            robots._frames.forget()
        if frame == 19 and n > 1:
            robots.stop(ids[1:2])
        if frame == 23 and n > 1:
            robots.reset(ids[1:2], [scene(9)], [9])
            action[1] = command[1]
        told: Any = action
        if takes_goals and frame in (2, 24):
            postures = command[:, : arm.chain.dof] + (np.arange(arm.chain.dof) == 0) * 0.4
            goals = [BrainCommand(str(frame), joint_target=tuple(one), gripper=0.02) for one in postures.tolist()]
            told = Goals({sim: (goal,) for sim, goal in enumerate(goals)})
        elif takes_goals and frame in (*range(3, 7), *range(25, FRAMES)):
            told = None  # they go on with it
        else:
            action[:] = [next_action(config, *one) for one in zip(action, rngs, strict=True)]
        report, seen, true = robots.step(told), robots.observe(), robots.truth()
        flags = np.stack([report.limits, report.watchdog, report.mode, seen.age_ns], axis=1)
        every = [seen.state, report.applied, flags, report.columns["control.effort"], robots.cerebellum.written]
        every += [robots.physics_state, *(field.reshape(n, -1) for field in vars(true).values())]
        if takes_goals:
            every.append(np.array([[len(robots.bridge.take_results(sim))] for sim in range(n)]))
        rows.append(np.where(robots.running[:, None], np.concatenate(every, axis=1), 0.0))  # those apart: nothing
    assert alone is None or robots._frames._is_prepared
    robots.close()
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_the_bits_of_ticks_and_steps_in_turns(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """For any share of threads; alone, tick by tick as on the wall clock; and in plain Python."""
    make_config, options = KINDS[kind]
    if options.get("physics_hz") == 100:
        monkeypatch.setattr("bhd_lerobot.bodies.body.Body.check_rates", lambda *_, **__: None)
    config, calls = make_config(**options), count_calls(monkeypatch)
    fast = play(config, 4, threads=3)
    assert len(calls) >= FRAMES
    np.testing.assert_array_equal(play(config, 4, threads=1), fast)
    np.testing.assert_array_equal(play(config, 1, alone=monkeypatch), fast[:, :1])
    with kernels.plain_python():
        calls.clear()
        np.testing.assert_array_equal(play(config, 2), fast[:, :2])
        assert not calls


def test_physics_that_diverges_is_found() -> None:
    simulation = make(3)
    simulation.world.qvel[1, 0] = 1e300
    with pytest.raises(SimulationError, match=r"simulation\(s\) \[1\] diverged"):
        simulation.step(np.zeros((3, 2)))
    simulation.close()


class Between:
    """A plant before a plant, which counts what is written."""

    def __init__(self, plant: Any) -> None:
        self.plant, self.writes = plant, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.plant, name)

    def write(self, ctrl: NDArray[np.float64]) -> None:
        self.writes += 1
        self.plant.write(ctrl)


def test_a_plant_that_is_put_in_between_sees_every_write() -> None:
    simulation = make(1)
    simulation.cerebellum.plant = between = Between(simulation.plant)  # type: ignore[assignment]
    simulation.step(np.zeros((1, 2)))
    assert between.writes == simulation.rates.ticks_per_frame
    simulation.close()


def after(what: str) -> NDArray[np.float64]:
    """Return what is seen and true of bases in which something comes between two ticks that run alone."""
    simulation, more = make(2 if what == "another base" else 1, physics_hz=600), np.zeros(0)
    first = simulation.physics_state

    def tick(count: int) -> None:
        for _ in range(count):
            simulation.run_tick(simulation.bridge.now_ns, 1)
            simulation.bridge._tick += 1

    simulation.send(np.full((simulation.n, 2), (0.15, 0.5)))
    tick(20)
    match what:
        case "another scene":
            simulation.reset(np.zeros(1, np.intp), [make_arena("random", 9, robot_radius=0.105)], [9])
        case "an earlier state":
            simulation.restore_physics(0, first[0])
        case "a tick of the world alone":
            simulation.advance()
        case "ticks that are skipped":
            simulation.run_tick(simulation.bridge.now_ns, 2)
            simulation.bridge._tick += 2
            tick(1)
        case "an end":
            simulation.stop(np.zeros(1, np.intp))
            tick(5)
        case "another word of the stop":
            simulation.cerebellum.estop = EstopWord(1)
            simulation.estop()
            tick(5)
        case "another plant":
            simulation.cerebellum.plant = between = Between(simulation.plant)  # type: ignore[assignment]
            tick(5)
            more = np.array([between.writes])
        case "one more field that is read":
            more = simulation.world.derived("xpos")
            tick(5)
        case _:
            tick(5)
    efforts = simulation.cerebellum.states["effort"]
    every = [simulation.observe().state, simulation.physics_state, simulation.modes, efforts, more]
    simulation.close()
    return np.concatenate([np.ravel(values) for values in every])


@pytest.mark.law
@each_case(
    "what",
    [
        *("another scene", "an earlier state", "a tick of the world alone", "ticks that are skipped", "an end"),
        *("another word of the stop", "another plant", "one more field that is read", "another base"),
    ],
)
def test_whatever_comes_between_two_ticks_that_run_alone_it_counts_at_once(what: str) -> None:
    fast = after(what)
    with kernels.plain_python():
        np.testing.assert_array_equal(fast, after(what))


def test_a_tick_alone_is_plain_python_while_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, calls = make(1), count_calls(monkeypatch)
    for tick in range(3):
        with kernels.plain_python() if tick == 1 else nullcontext():
            simulation.run_tick(tick * 5_000_000, 1)
        assert len(calls) == (tick + 2) // 2
    simulation.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_frame_of_robots_that_are_all_left_alone_moves_none(threads: int) -> None:
    simulation = make(2, threads)
    simulation.step(np.full((2, 2), 0.1))
    simulation.stop(np.arange(2))
    before, tick = simulation.physics_state, simulation.tick
    simulation.step(np.full((2, 2), 0.1))
    np.testing.assert_array_equal(simulation.physics_state, before)
    assert simulation.tick == tick + simulation.rates.ticks_per_frame
    simulation.close()


FIELDS = ("xfrc_applied", "qacc_warmstart", "ncon", "xquat", "qfrc_bias", "actuator_force")


@pytest.mark.parametrize("count", [1, 2, 3, 6, 20])
def test_whatever_is_read_of_a_world_the_physics_is_the_same(count: int) -> None:
    """Fields of the state, numbers, derived fields, and more of these than frames copy."""

    def fields(simulation: Simulation) -> dict[str, NDArray[np.float64]]:
        names = [*FIELDS, *(name for name in simulation.world.one._all_fields if name.startswith("x"))][:count]
        return {name: simulation.world.derived(name) for name in names}

    def seen() -> list[NDArray[np.float64]]:
        simulation = make(3)
        bound = fields(simulation)
        if "xfrc_applied" in bound:
            bound["xfrc_applied"][1, -1, 2] = 1.0
        for frame in range(3):
            simulation.step(np.full((3, 2), 0.1 * frame))
        simulation.close()
        return [simulation.world.qpos.copy(), *(field.copy() for field in bound.values())]

    fast = seen()
    with kernels.plain_python():
        plain = seen()
    for one, other in zip(fast, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_a_subclass_does_after_steps_is_done() -> None:
    class Counting(Simulation):
        steps = 0

        def _after_step(self) -> None:
            super()._after_step()
            self.steps += 1

    simulation = Counting(TurtleBot3Config(), 1)
    simulation.reset(np.arange(1), [make_arena("empty", 0, robot_radius=0.105)], [0])
    simulation.step(np.zeros((1, 2)))
    assert simulation.steps == simulation.rates.ticks_per_frame
    simulation.close()


def test_after_an_interruption_the_next_frame_waits_for_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = make(4, 2)
    simulation.step(np.zeros((4, 2)))
    real, most = frames._Thread._run, [0, 0]

    def counted(*arguments: Any) -> None:
        most[0] += 1
        most[1] = max(most)
        time.sleep(0.05)
        real(*arguments)
        most[0] -= 1

    def interrupted(_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(frames._Thread, "_run", counted)
    with monkeypatch.context() as patch:
        patch.setattr(frames, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulation.step(np.zeros((4, 2)))
    for _ in range(3):
        simulation.step(np.zeros((4, 2)))
    assert most[1] <= 2  # one for each thread's data
    simulation.close()


def test_closing_ends_the_threads() -> None:
    before = threading.active_count()
    simulation = make(4, 3)
    simulation.step(np.zeros((4, 2)))
    assert threading.active_count() > before
    simulation.close()
    simulation.close()
    assert threading.active_count() <= before
