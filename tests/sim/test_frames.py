"""Frames in machine code: the bits of ticks and steps in turns, whatever happens between and within them."""

import threading
import time
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control import kernels
from bhd_lerobot.control.commands import BrainCommand, Goals, Pose
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


def run(
    n: int, threads: int | None = None, alone: pytest.MonkeyPatch | None = None, **options: Any
) -> NDArray[np.float64]:
    """Return everything that is observed, reported and true of bases that run into things, stop, and go on."""
    simulation, rng, rows = make(n, threads, **options), np.random.default_rng(0), []
    if alone is not None:
        tick_alone(simulation, alone)
    friction = simulation.world.model_field("geom_friction")
    for frame in range(FRAMES):
        if frame == 8:
            simulation.estop()
        if frame == 12:
            simulation.bridge.reset()
            simulation.bridge.activate()
        if frame == 16:
            friction[:, :, 0] *= 0.3  # written to between two frames: it counts from the next step on
            simulation._frames.forget()
        if frame == 20 and n > 1:
            simulation.stop(np.array([1]))
        if frame == 24 and n > 1:
            simulation.reset(np.array([1]), [make_arena("random", 9, robot_radius=0.105)], [9])
        report = simulation.step(rng.uniform(-1, 1, (n, 2)) * (0.3, 3.0))
        seen, pose = simulation.observe(), simulation.truth()
        flags = np.stack([report.limits, report.watchdog, report.mode, seen.age_ns, pose.touched], axis=1)
        efforts = report.columns["control.effort"]
        every = np.concatenate([seen.state, report.applied, flags, efforts, simulation.physics_state], axis=1)
        rows.append(np.where(simulation.running[:, None], every, 0.0))  # of robots that were left alone nothing is said
    assert alone is None or simulation._frames._is_prepared
    simulation.close()
    return np.array(rows)


@each_case(
    "options",
    [{}, {"imu": True, "collision_monitor": True}, {"physics_hz": 600}, {"physics_hz": 100, "control_hz": 50}],
)
@pytest.mark.parametrize(("n", "threads"), [(1, None), (5, 1), (5, 3)])
def test_frames_are_the_bits_of_ticks_and_steps_in_turns(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], n: int, threads: int | None
) -> None:
    if options.get("physics_hz") == 100:
        monkeypatch.setattr("bhd_lerobot.bodies.body.Body.check_rates", lambda *_, **__: None)
    calls = count_calls(monkeypatch)
    fast = run(n, threads, **options)
    assert calls
    if n == 1:
        np.testing.assert_array_equal(run(1, alone=monkeypatch, **options), fast)
    with kernels.plain_python():
        calls.clear()
        plain = run(n, threads, **options)
        assert not calls
    np.testing.assert_array_equal(fast, plain)


class Reacher:
    """What arms are told to do: by setpoints, by goals, and something else in between."""

    def __init__(
        self, n: int, threads: int | None, options: dict[str, Any], alone: pytest.MonkeyPatch | None = None
    ) -> None:
        config = UR5Config(**options)
        self.arm = Simulation(config, n, threads)
        self.alone = alone is not None
        if alone is not None:
            tick_alone(self.arm, alone)
        self.task = PickTask(
            PickConfig(randomisation=RandomisationConfig(enabled=True, latency_s=0.01)), n, config.fps, config.body()
        )
        self.all, self.rng = np.arange(n), np.random.default_rng(0)
        self.arm.reset(self.all, [self.task.sample(sim) for sim in range(n)], self.all.tolist())
        self.action = self.arm.cerebellum.command.copy()

    def disturb(self, frame: int) -> None:
        """Stop, reset, leave alone and start again."""
        bridge, n = self.arm.bridge, len(self.all)
        if frame == 20:
            bridge.estop(self.all[:1])
        if frame == 26:
            bridge.reset()
            bridge.activate()
            self.action[:] = self.arm.cerebellum.command
        if frame == 30 and n > 1:
            self.arm.stop(np.array([1]))
        if frame == 34 and n > 1:
            self.arm.reset(np.array([1]), [self.task.sample(7)], [7])
            self.action[:] = self.arm.cerebellum.command

    def run(self) -> NDArray[np.float64]:
        rows, by_pose = [], self.arm.config.control == "impedance"
        for frame in range(44):
            self.disturb(frame)
            goals: dict[int, tuple[BrainCommand, ...]] = {}
            if not by_pose and frame in (2, 12, 13, 36):
                pose = Pose((0.5, 0.1 - 0.01 * frame, 0.2), (0.0, 1.0, 0.0, 0.0))
                opening = 0.02 if frame == 13 else 0.08
                goals = {sim: (BrainCommand(f"{frame}", target_pose=pose, gripper=opening),) for sim in self.all}
            is_goal = bool(goals) or frame in range(2, 8) or frame in range(12, 20) or frame > 36
            if by_pose:
                self.action[:, :3] += self.rng.uniform(-0.01, 0.01, (len(self.all), 3)) - (0.0, 0.0, 0.01)
                report = self.arm.step(self.action)
            elif is_goal:
                report = self.arm.step(Goals(goals))
            else:
                self.action[:, :6] += self.rng.uniform(-0.06, 0.06, (len(self.all), 6)) - (0.0, 0.05, 0, 0, 0, 0)
                report = self.arm.step(self.action)
            seen, true = self.arm.observe(), self.arm.truth()
            touches = np.stack([true.arm_on_table, true.arm_on_object, true.self_contact], axis=1)
            flags = np.stack([report.limits, report.watchdog, report.mode], axis=1)
            results = [[len(self.arm.bridge.take_results(int(sim)))] for sim in self.all]
            every = [seen.state, report.applied, flags, touches, report.columns["control.effort"], results]
            every += [true.tool_pose, self.arm.physics_state]
            row = np.concatenate(every, axis=1)
            rows.append(np.where(self.arm.running[:, None], row, 0.0))
        assert not self.alone or self.arm._frames._is_prepared
        self.arm.close()
        return np.array(rows)


@each_case(
    "options",
    [
        {},
        {"wrench": True},
        {"physics_hz": 1000},
        {"max_force": 30.0, "jerk_limits": False},
        {"control": "impedance", "action_space": "tool"},
    ],
)
@pytest.mark.parametrize(("n", "threads"), [(1, None), (4, 1), (4, 3)])
def test_frames_of_arms_are_the_bits_of_ticks_and_steps_in_turns(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], n: int, threads: int | None
) -> None:
    calls = count_calls(monkeypatch)
    fast = Reacher(n, threads, options).run()
    assert len(calls) >= 44
    if n == 1:
        np.testing.assert_array_equal(Reacher(1, threads, options, monkeypatch).run(), fast)
    with kernels.plain_python():
        calls.clear()
        plain = Reacher(n, threads, options).run()
        assert not calls
    np.testing.assert_array_equal(fast, plain)


def wander(config: Any, n: int, alone: pytest.MonkeyPatch | None = None) -> NDArray[np.float64]:
    """Return what arms observe, write and report that follow setpoints and goals, stop, and go on."""
    robots, rng, rows = Simulation(config, n), np.random.default_rng(0), []
    if alone is not None:
        tick_alone(robots, alone)
    robots.reset(np.arange(n), [config.start_scene()] * n, list(range(n)))
    cerebellum, dof = robots.cerebellum, len(robots.body.need(Arm).chain.joints)
    action, posture = cerebellum.command.copy(), tuple((cerebellum.command[0, :dof] + 0.3).tolist())
    for frame in range(20):
        action += rng.uniform(-0.1, 0.1, (2, action.shape[1]))[:n]
        command: Any = action
        if frame == 3:
            command = Goals({sim: (BrainCommand("a", joint_target=posture, gripper=0.01),) for sim in range(n)})
        elif 3 < frame < 8:
            command = None
        elif frame == 12:
            robots.estop()
        elif frame == 17:
            robots.bridge.reset()
            robots.bridge.activate()
        report = robots.step(command)
        flags = np.stack([report.limits, report.watchdog, report.mode], axis=1)
        rows.append([robots.observe().state, report.applied, cerebellum.written.copy(), flags, robots.physics_state])
    assert alone is None or robots._frames._is_prepared
    robots.close()
    return np.array([np.concatenate(row, axis=1) for row in rows])


@pytest.mark.parametrize(
    "config",
    [
        TurtleBot3ManipulationConfig(beams=90, imu=True, collision_monitor=True, arena="random"),
        SO101Config(),
        SO101Config(control_hz=100, fps=10, jerk_limits=False),
    ],
    ids=["on a base", "from a file", "seldom"],
)
def test_frames_of_arms_on_bases_and_from_files_are_the_bits_of_ticks_and_steps_in_turns(
    monkeypatch: pytest.MonkeyPatch, config: Any
) -> None:
    calls = count_calls(monkeypatch)
    fast = wander(config, 2)
    assert calls
    np.testing.assert_array_equal(wander(config, 1, monkeypatch), fast[:, :1])
    with kernels.plain_python():
        calls.clear()
        np.testing.assert_array_equal(fast, wander(config, 2))
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
