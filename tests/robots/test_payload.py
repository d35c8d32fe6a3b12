"""What the gripper carries: motions that the motors can give, and a load that was not declared."""

import dataclasses

import numpy as np
import pytest
from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur import MODELS, ur, ur5
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.geometry.dynamics import ArmDynamics, acceleration_share
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host import simulation
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim.world import World

FIRST = np.zeros(1, np.intp)
HOME = np.array(ur5().arm.home)
EFFORT = np.array(ur5().limits.effort[:6])
BODY = '<body name="payload" pos="0 0 0.150"><inertial pos="0 0 0" mass="{}" diaginertia="1e-3 1e-3 1e-3"/></body>'


def carrying(monkeypatch: pytest.MonkeyPatch, mass: float, declared: float, name: str = "ur5") -> Simulation:
    """Return an arm whose tool carries a mass [kg], which its gravity compensation knows nothing of."""

    def make(body: Body, *arguments: object, **options: object) -> World:
        mjcf = body.mjcf.replace('<site name="tool"', BODY.format(mass) + '<site name="tool"')
        world = World(dataclasses.replace(body, mjcf=mjcf), *arguments, **options)  # type: ignore[arg-type]
        world.model_field("body_gravcomp")[:, world.model.body("payload").id] = 0.0
        return world

    monkeypatch.setattr(simulation, "World", make)
    return Simulation(RobotConfig.get_choice_class(name)(payload=declared), threads=1)


def goals(count: int, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return pairs of postures between which an arm may move, the first of which needs most torque."""
    rng, planner, found = np.random.default_rng(0), GoalPlanner(ur(name), 500), []
    loaded = ur(name, load=ur(name).arm.payload)
    dynamics, effort = ArmDynamics(loaded), loaded.limits.effort[:6]
    while len(found) < 12 * count:
        start, end = HOME[:6] + rng.uniform(-1.2, 1.2, (2, 6))
        if min(distances.min() for distances in planner.kinematics.collision.distances(start[None])) < 0.02:
            continue
        plan = planner.plan(BrainCommand("x", joint_target=tuple(end)), [*start, 0.02], np.zeros(7), np.zeros(7))
        if isinstance(plan, Plan):
            path = plan.trajectory
            states = [np.ascontiguousarray(part[:, :6]) for part in (path.position, path.velocity, path.acceleration)]
            found.append((float((np.abs(dynamics.torque(*states)) / effort).max()), start, end))
    found.sort(key=lambda pair: -pair[0])
    assert found[0][0] > 1.05  # with its payload, at the full accelerations
    return [(start, end) for _, start, end in found[:count]]


@pytest.mark.parametrize("name", MODELS)
def test_the_rated_payload_is_moved_within_the_torque_limits(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    payload = ur(name).arm.payload
    arm = carrying(monkeypatch, payload, payload, name)
    effort = np.array(arm.body.limits.effort[:6])
    for number, (start, end) in enumerate(goals(2, name)):
        arm.reset(FIRST, [TableScene("", (), (*start, 0.02))], [0])
        for _ in range(10):
            arm.step(None)
        assert arm.bridge.submit(BrainCommand(f"goal {number}", joint_target=tuple(end))) is None
        results, most = [], np.zeros(6)
        while not results:
            for _ in range(20):
                arm.bridge.advance_ticks(1)
                most = np.maximum(most, np.abs(arm.cerebellum.reading.effort[0, :6]) / effort)
            results = arm.bridge.take_results()
        assert results[0].code == ResultCode.SUCCEEDED
        assert most.max() < 0.999, most


def test_setpoints_with_the_rated_payload_stay_within_the_torque_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = carrying(monkeypatch, 5.0, 5.0)
    rng = np.random.default_rng(1)
    arm.reset(FIRST, [TableScene("", (), (*HOME[:6], 0.02))], [0])
    most = np.zeros(6)
    for frame in range(100):
        if frame % 10 == 0:
            target = np.array([[*(HOME[:6] + rng.uniform(-0.6, 0.6, 6)), 0.02]])
        arm.bridge.send(target)
        for _ in range(20):
            arm.bridge.advance_ticks(1)
            most = np.maximum(most, np.abs(arm.cerebellum.reading.effort[0, :6]) / EFFORT)
    assert arm.modes[0] == Mode.TRACKING
    assert most.max() < 0.999, most


def test_a_load_that_was_not_declared_is_a_fault_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = carrying(monkeypatch, 5.0, 1.0)
    arm.reset(FIRST, [TableScene("", (), (*HOME[:6], 0.02))], [0])
    arm.bridge.submit(BrainCommand("hold", joint_target=tuple(HOME[:6] + 0.01), timeout_s=5.0))
    watchdog = 0
    for _ in range(50):
        watchdog |= int(arm.step(None).watchdog[0])
    assert arm.modes[0] == Mode.FAULT
    assert watchdog & Watchdog.FORCE


def test_a_declared_load_is_none_that_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    for mass, declared in ((5.0, 5.0), (1.5, 0.0), (4.0, 5.0)):
        arm = carrying(monkeypatch, mass, declared)
        arm.reset(FIRST, [TableScene("", (), (*HOME[:6], 0.02))], [0])
        for _ in range(50):
            arm.step(None)
        assert arm.modes[0] == Mode.HOLD, (mass, declared)


@pytest.mark.parametrize(("mass", "most"), [(1.5, 2e-3), (4.0, 0.06)])
def test_a_stopped_arm_with_a_load_that_was_not_declared_does_not_sink(
    monkeypatch: pytest.MonkeyPatch, mass: float, most: float
) -> None:
    """What need not be declared is no push; by more it sinks a little, once."""
    arm = carrying(monkeypatch, mass, 0.0)
    arm.reset(FIRST, [TableScene("", (), (*HOME[:6], 0.02))], [0])
    arm.cerebellum.estop.press()
    heights = []
    for _ in range(100):
        arm.step(None)
        heights.append(float(arm.table.tool_pose[0, 2]))
    assert heights[0] - heights[-1] < most
    assert heights[75] - heights[-1] < 1e-3


def test_a_load_slows_motions_down_and_none_changes_nothing() -> None:
    shares = [acceleration_share(ur5(load=load)) for load in (0.0, 1.0, 2.0, 5.0)]
    assert shares[0] == 1.0
    assert (np.diff(shares) < 0).all()
    with pytest.raises(ConfigError, match="a UR5 carries between 0 and 5 kg"):
        UR5Config(payload=6.0)
