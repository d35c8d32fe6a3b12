"""What setpoints may touch: nothing. And what happens to an arm that presses on something nevertheless."""

import re
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableScene, Variation
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.messages import Limit, Mode, Request, Watchdog
from bhd_lerobot.errors import CommandRefusedError, ConfigError
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.ur import UR5
from tests.robots.forces import Contacts, Wall

FIRST = np.zeros(1, np.intp)
LEAST = 0.003  # [m] in the hardest reversals an arm may come so near, of the 0.005 that goals keep
LIGHT_N, WITHIN_S = 20.0, 0.5
INTO_TABLE, INTO_ITSELF, INTO_BOX = (0, 1, 0, 0, 0, 0, 0), (0, 0, 1, -1, 1, 0, 0), (1, 0, 0, 0, 0, 0, 0)
BOX = Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8)


class Pusher:
    """A UR5 on an empty table, with the forces of every tick."""

    def __init__(
        self, *, clearance: bool = True, measures: bool = False, fixtures: tuple[Shape, ...] = (), **config: Any
    ) -> None:
        self.arm = arm = Simulation(UR5Config(**config), 1, threads=1, fixtures=fixtures)
        arm.reset(FIRST, [TableScene("empty", (), arm.body.arm.home)], [0])
        self.controller: Any = arm.cerebellum.controller
        if not clearance:
            self.controller.arm_limits["keeps_clear"] = False
        self.action = arm.cerebellum.command.copy()
        self.limits = self.watchdog = 0
        self.forces: list[float] = []
        self.faulty_since: int | None = None
        if measures:
            after, contacts = arm._after_tick, Contacts(arm)

            def measure() -> None:
                after()
                self.forces.append(contacts.force())
                if self.faulty_since is None and self.mode == Mode.FAULT:
                    self.faulty_since = len(self.forces)

            arm._after_tick = measure  # type: ignore[method-assign]

    def step(self, action: np.ndarray) -> None:
        limits = self.arm.body.limits  # type: ignore[union-attr]
        self.action = np.clip(action, limits.lower, limits.upper)
        report = self.arm.step(self.action)
        self.limits |= int(report.limits[0])
        self.watchdog |= int(report.watchdog[0])

    @property
    def mode(self) -> Mode:
        return Mode(int(self.arm.cerebellum.mode[0]))

    @property
    def distance(self) -> float:
        """How far the arm is from itself and from the table, whichever is less [m]."""
        q = self.arm.cerebellum.reading.position[:, :6]
        return min(float(one[0]) for one in self.arm.kinematics.collision.distances(q))


@pytest.mark.parametrize("where", [INTO_TABLE, INTO_ITSELF], ids=["table", "itself"])
def test_setpoints_slow_an_arm_down_and_stop_it_before_it_touches_anything(where: tuple[int, ...]) -> None:
    for rate in (0.6, 3.0, 50.0):  # [rad/s] the last is a step
        pusher = Pusher()
        distances = []
        for _ in range(round(2.5 / min(rate, 3.0) * 25) + 30):
            pusher.step(pusher.action + np.array(where)[None] * rate / 25)
            distances.append(pusher.distance)
        assert not any(touch.any() for touch in pusher.arm.touches)
        assert min(distances) > LEAST
        assert distances[-1] < 0.02  # it comes near
        assert pusher.limits & Limit.CLEARANCE
        assert (pusher.mode, pusher.watchdog) == (Mode.TRACKING, 0)
        assert np.abs(pusher.arm.cerebellum.reading.velocity[0, :6]).max() < 0.02
        # Away it may go at once.
        home = np.array(pusher.arm.body.arm.home)[None]  # type: ignore[union-attr]
        for _ in range(60):
            pusher.step(home)
        np.testing.assert_allclose(pusher.arm.cerebellum.reading.position, home, atol=2e-3)


def test_random_setpoints_touch_nothing_and_are_no_false_alarm() -> None:
    reached = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pusher = Pusher()
        far = rng.uniform(-2, 2, 7) * (1, 1, 1, 1, 1, 1, 0)
        for frame in range(60):
            pusher.step(pusher.action + far * (frame % 15 == 0) * rng.choice([-1, 1], 7))
            assert pusher.distance > LEAST
        assert not any(touch.any() for touch in pusher.arm.touches)
        assert not pusher.watchdog
        reached += bool(pusher.limits & Limit.CLEARANCE)
    assert reached >= 3


@pytest.mark.thorough(but=3)
@pytest.mark.parametrize("where", [INTO_TABLE, INTO_ITSELF, INTO_BOX], ids=["table", "itself", "box"])
@pytest.mark.parametrize("rate", [0.5, 1.5, 3.0])
def test_an_arm_that_presses_stops_and_lets_go(where: tuple[int, ...], rate: float) -> None:
    pusher = Pusher(clearance=False, measures=True, fixtures=(BOX,) if where == INTO_BOX else ())
    for _ in range(2):  # also after a reset
        pusher.watchdog, pusher.faulty_since = 0, None
        pusher.forces.clear()
        for _ in range(round(3.5 / rate * 25)):
            pusher.step(pusher.action + np.array(where)[None] * rate / 25)
            if pusher.faulty_since is not None:
                break
        assert pusher.watchdog == Watchdog.FORCE  # the stop itself needs no guard
        assert max(pusher.forces) > pusher.controller.arm_limits["most_force"][0]
        for _ in range(40):
            pusher.arm.step(None)
        after = pusher.forces[pusher.faulty_since :]
        assert max(after[round(WITHIN_S * 500) :]) < LIGHT_N
        assert pusher.mode == Mode.FAULT
        for request in (Request.RESET, Request.ACTIVATE):
            assert pusher.arm.cerebellum.request(request).accepted.all()
        pusher.action = pusher.arm.cerebellum.command.copy()


@pytest.mark.parametrize("cause", ["fault", "emergency stop"])
def test_a_stopped_arm_lets_go_of_the_table_and_stays_so_after_reset_and_activate(cause: str) -> None:
    pusher = Pusher(clearance=False, measures=True)
    cerebellum: Any = pusher.arm.cerebellum
    while not pusher.forces or pusher.forces[-1] < 60.0:
        pusher.step(pusher.action + np.array(INTO_TABLE)[None] * 0.1 / 25)
    if cause == "fault":
        read, faults = cerebellum.plant.read, [True]

        def broken(out: Any) -> None:
            read(out)
            out.safety[:] = bool(faults) and faults.pop()

        cerebellum.plant.read = broken
    else:
        cerebellum.estop.press()
    pusher.arm.step(None)
    assert pusher.mode == (Mode.FAULT if cause == "fault" else Mode.ESTOP)
    for _ in range(round(WITHIN_S * 25)):
        pusher.arm.step(None)
    assert pusher.forces[-1] < LIGHT_N
    where = cerebellum.reading.position.copy()
    for request in (Request.RESET, Request.ACTIVATE):
        assert cerebellum.request(request).accepted.all()
    for _ in range(50):
        pusher.arm.step(None)
    assert pusher.forces[-1] < LIGHT_N
    assert np.abs(cerebellum.reading.position - where)[0, :6].max() < 0.01  # it has not moved on, nor sunk


def test_a_goal_into_something_unknown_ends_and_lets_go() -> None:
    pusher = Pusher(measures=True, fixtures=(Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8),))
    home = pusher.arm.body.arm.home  # type: ignore[union-attr]
    assert pusher.controller.submit(0, BrainCommand("into", joint_target=(home[0] + 2.0, *home[1:6]))) is None
    for _ in range(100):
        report = pusher.arm.step(None)
        pusher.watchdog |= int(report.watchdog[0])
        if report.results:
            break
    assert pusher.watchdog & Watchdog.FORCE
    (result,) = report.results[0]
    assert result.code == ResultCode.PATH_TOLERANCE
    assert "150 N is the most" in result.message
    for _ in range(40):
        pusher.arm.step(None)
    assert max(pusher.forces[pusher.faulty_since :][round(WITHIN_S * 500) :]) < LIGHT_N


def test_more_force_may_be_allowed() -> None:
    pusher = Pusher(clearance=False, max_force=float("inf"))
    for _ in range(60):
        pusher.step(pusher.action + np.array(INTO_TABLE)[None] * 1.0 / 25)
    assert not pusher.watchdog & Watchdog.FORCE
    assert pusher.watchdog & Watchdog.BLOCKED  # it is held fast
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match=r"max_force is .*positive"):
            UR5Config(max_force=wrong)


def test_what_the_surroundings_put_on_the_tool_is_estimated_if_asked_for() -> None:
    """Beside the contact forces of the simulator: the table pushes the tool up, and a frame later it is known."""
    pusher = Pusher(clearance=False, measures=True, wrench=True, max_force=400.0)
    felt, true = [], []
    for _ in range(60):
        report = pusher.arm.step(pusher.action)
        felt.append(report.columns["control.wrench"][0])
        true.append(pusher.forces[-1])
        if pusher.forces[-1] < 60.0:
            pusher.action = pusher.action + np.array(INTO_TABLE)[None] * 0.5 / 25
    assert true[-1] > 60.0  # it rests on the table, and presses
    assert felt[-1][2] == pytest.approx(true[-1], rel=0.3)
    assert np.linalg.norm(felt[-1][:2]) < 0.5 * felt[-1][2]
    free = [np.linalg.norm(one[:3]) for one, force in zip(felt, true, strict=True) if not force]
    assert np.median(free) < 15.0
    assert "control.wrench" not in Pusher().arm.step(pusher.action).columns


def test_setpoints_and_goals_keep_away_from_obstacles_that_are_declared() -> None:
    """A post in the way of the turning base, as the simulator has it, and as it was declared: a little thicker."""
    post = Shape("cylinder", 0.25, 0.55, 0.0, 0.08, 0.08, 0.8)
    declared = [0.25, 0.55, 0.0, 0.25, 0.55, 0.8, 0.085]
    for rate in (0.6, 3.0):
        blind, pusher = (Pusher(fixtures=(post,), obstacles=obstacles) for obstacles in ([], [declared]))
        least = []
        for _ in range(round(2.0 / rate * 25) + 40):
            for one in (blind, pusher):
                one.step(one.action + np.array([1, 0, 0, 0, 0, 0, 0])[None] * rate / 25)
            least.append(pusher.distance)
        assert blind.watchdog & Watchdog.FORCE
        assert not any(touch.any() for touch in pusher.arm.touches)
        assert LEAST < min(least) < 0.02
        assert (pusher.mode, pusher.watchdog) == (Mode.TRACKING, 0)
        assert pusher.limits & Limit.CLEARANCE
    pusher = Pusher(fixtures=(post,), obstacles=[declared])
    home = pusher.arm.body.arm.home  # type: ignore[union-attr]
    assert pusher.controller.submit(0, BrainCommand("by", joint_target=(home[0] + 2.5, *home[1:6]))) is None
    while not (results := pusher.arm.step(None).results):
        pass
    (result,) = results[0]
    assert result.code == ResultCode.SELF_COLLISION
    assert "of obstacle_0; 0.005 m is the least" in result.message
    for wrong in ([0.1] * 6, [0.1] * 6 + [0.0], [float("nan")] + [0.1] * 6, [1e200] + [0.1] * 6):
        with pytest.raises(ConfigError, match=r"robot.obstacles has .* as number 0; an obstacle is 7 numbers"):
            UR5Config(obstacles=[wrong])


UP, DOWN, ASIDE, ASKEW = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.3, 1.0, 0.0), (-0.5, 0.4, 0.6)
PUSHES = [  # direction, speed [m/s] and time for which a wall comes [s], its stiffness [N/m], latency of the arm [s]
    (DOWN, 0.02, 4.0, 2e4, 0.0),
    (UP, 0.05, 2.0, 2e4, 0.0),
    (ASIDE, 0.05, 3.0, 2e5, 0.0),
    (ASKEW, 0.1, 1.5, 2e4, 0.0),
    (ASKEW, 0.03, 2.0, 1e3, 0.0),
    (ASIDE, 0.05, 2.0, 2e4, 0.03),
]


def test_a_stopped_arm_gives_way_for_as_long_as_it_is_pushed() -> None:
    """After an emergency stop, the first of them, and after a fault."""
    pushes, n = [*PUSHES, *PUSHES], 2 * len(PUSHES)
    directions, *numbers = (np.array(values) for values in zip(*pushes, strict=True))
    speed, seconds, stiffness, latency = numbers
    arm = Simulation(UR5Config(), n, threads=1)
    home = arm.body.arm.home  # type: ignore[union-attr]
    scenes = [TableScene("empty", (), home, variation=Variation(latency_s=one)) for one in latency.tolist()]
    arm.reset(np.arange(n), scenes, [0] * n)
    arm.cerebellum.estop.press(np.arange(n // 2))
    arm.step(None)
    arm.cerebellum.interrupt(Watchdog.MISSES, Mode.FAULT)
    arm.step(None)
    assert arm.modes.tolist() == [Mode.ESTOP] * (n // 2) + [Mode.FAULT] * (n // 2)
    wall, logged = Wall(arm, directions, speed, seconds, stiffness), []
    for _ in range(150):
        arm.step(None)
        reading = arm.cerebellum.reading
        logged.append((wall.force, np.abs(reading.velocity[:, :6]).max(axis=1), reading.position.copy()))
    force, fastest, position = (np.array(values) for values in zip(*logged, strict=True))
    for one, push in enumerate(pushes):
        end = round(25 * seconds[one])  # of the push; soft things are followed for longer
        rest = end + round(25 * (2 * WITHIN_S if stiffness[one] > 1e4 else 3.0))
        assert 0.0 < force[end // 2 : end, one].max() < 300.0, push
        assert fastest[:end, one].max() < 1.5, push
        assert force[(end + rest) // 2 : rest, one].max() < LIGHT_N, push
        assert np.abs(position[rest + 24, one] - position[rest - 1, one]).max() < 2e-3, push  # it has not gone on
    assert all(arm.cerebellum.request(one).accepted.all() for one in (Request.RESET, Request.ACTIVATE))


def test_a_hard_push_that_stays_as_it_is_while_it_is_followed_is_no_load() -> None:
    """In a direction that the joints hardly feel; taken for a load, it became twice as hard."""
    arm = Simulation(UR5Config(), 1, threads=1)
    posture = (0.6186, -1.6973, -0.6542, -0.4595, 0.942, 2.2784, 0.085)
    arm.reset(FIRST, [TableScene("empty", (), posture)], [0])
    arm.cerebellum.estop.press()
    arm.step(None)
    wall, most = Wall(arm, np.array((0.651, 0.103, 0.752)), 0.05, 2.0), 0.0
    for _ in range(50):
        arm.step(None)
        most = max(most, float(wall.force[0]))
    assert 150.0 < most < 650.0


def test_an_arm_in_hold_is_watched_after_reset_and_activate_before_any_command() -> None:
    arm = Simulation(UR5Config(), 4, threads=1)
    arm.reset(np.arange(4), [TableScene("empty", (), arm.body.arm.home)] * 4, [0] * 4)  # type: ignore[union-attr]
    arm.cerebellum.estop.press()
    for _ in range(5):
        arm.step(None)
    assert all(arm.cerebellum.request(one).accepted.all() for one in (Request.RESET, Request.ACTIVATE))
    wall, most = Wall(arm, np.array((UP, DOWN, ASIDE, ASKEW)), 0.1, 10.0), np.zeros(4)
    for _ in range(1000):
        is_held = arm.modes == Mode.HOLD
        if not is_held.any():
            break
        arm.bridge.advance_ticks(1)
        np.maximum(most, wall.force, out=most, where=is_held)
    assert (arm.modes == Mode.FAULT).all()
    assert (most < 350.0).all()
    assert (arm.cerebellum.take_flags()[1] & (Watchdog.FORCE | Watchdog.BLOCKED)).all()


@pytest.mark.parametrize("force", [50.0, 120.0])
def test_an_arm_that_is_pressed_is_neither_reset_nor_activated_and_the_message_names_the_force(force: float) -> None:
    """By a force that follows it, so that giving way does not help."""
    robot = UR5(UR5Config(id="pressed"))
    robot.connect()
    try:
        arm: Any = robot.host
        robot.estop()
        external = arm.world._batch.bind("xfrc_applied")
        body = arm.world.model.body("gripper").id
        for step in range(20):
            external[0, body, 1] = force * min(1.0, step / 5)
            with pytest.raises(CommandRefusedError, match="emergency stop"):
                robot.send_action(dict(zip(robot.action_names, arm.cerebellum.command[0], strict=True)))
        with pytest.raises(CommandRefusedError, match=r"presses on something.*\((\d+) N, mode ESTOP\)") as refusal:
            robot.reset()
        named = float(re.findall(r"\((\d+) N", str(refusal.value))[0])
        assert named == pytest.approx(force, rel=0.3)
        external[0, body] = 0.0
        for _ in range(20):
            with pytest.raises(CommandRefusedError, match="emergency stop"):
                robot.send_action(dict(zip(robot.action_names, arm.cerebellum.command[0], strict=True)))
        robot.reset()
        robot.activate()
    finally:
        robot.disconnect()


def test_the_limit_of_force_holds_in_random_postures_and_directions() -> None:
    """Walls that come slowly: the true force, when the arm is stopped."""
    rng, body = np.random.default_rng(2), UR5Config().body()
    postures = np.array(body.arm.home)[:6] + rng.uniform(-1.2, 1.2, (200, 6))  # type: ignore[union-attr]
    far = np.min(ArmKinematics(body.arm.chain, body.limits).collision.distances(postures), axis=0) > 0.02  # type: ignore[union-attr]
    scenes = [TableScene("empty", (), (*posture, 0.04)) for posture in postures[far][:32]]
    arm = Simulation(UR5Config(), len(scenes))
    arm.reset(np.arange(len(scenes)), scenes, range(len(scenes)))
    directions = rng.normal(size=(len(scenes), 3))
    wall, most = Wall(arm, directions, 0.02, 10.0), np.zeros(len(scenes))
    for _ in range(60):
        arm.step(None)
        np.maximum(most, wall.force, out=most, where=arm.modes == Mode.HOLD)
    stopped = arm.modes == Mode.FAULT
    assert stopped.mean() > 0.9
    assert np.median(most[stopped]) < 170.0
    assert np.quantile(most[stopped], 0.9) < 200.0


BOUNCES = [
    ((3.60, -2.17, 1.50, -2.29, -1.87, -0.55), (0.77, 0.46, -0.43)),
    ((2.83, -2.40, 2.56, -0.33, -0.13, 0.94), (-0.52, 0.75, 0.40)),
    ((2.96, -1.54, 0.49, -2.14, -1.65, -0.86), (0.48, 0.66, -0.58)),
    ((4.19, -1.68, 0.57, -1.93, -1.12, -0.44), (-0.04, 0.52, 0.85)),
    ((3.27, -1.15, 0.36, -0.55, -1.25, 0.96), (0.48, -0.10, -0.87)),
]
"""Postures [rad], and directions in which a stiff wall stands: a joint bounces back while the stop begins."""


def test_the_stop_of_an_arm_that_drives_fast_into_a_wall_needs_no_guard() -> None:
    starts = np.repeat(np.linspace(-0.004, 0.004, 5), len(BOUNCES))  # another phase of the contact each
    postures, directions = (np.tile(column, (5, 1)) for column in zip(*BOUNCES, strict=True))
    n, speed = len(starts), 0.25
    arm = Simulation(UR5Config(), n)
    scenes = [TableScene("empty", (), (*posture, 0.085)) for posture in postures + starts[:, None]]
    arm.reset(np.arange(n), scenes, range(n))
    Wall(arm, directions, 0.0, 1e9)
    forward, action = ForwardKinematics(arm.body.arm.chain), arm.cerebellum.command.copy()  # type: ignore[union-attr]
    twist = np.concatenate((-directions * speed / 25, np.zeros((n, 3))), axis=1)[..., None]
    watchdog = np.zeros(n, np.int64)
    for _ in range(15):
        jacobian = np.ascontiguousarray(forward.jacobian(action[:, :6]))
        square = jacobian @ np.swapaxes(jacobian, 1, 2) + 0.02**2 * np.eye(6)
        turn = np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(square, twist)
        action[:, :6] += np.clip(turn[..., 0], -0.08, 0.08)
        watchdog |= np.asarray(arm.step(action).watchdog)
    assert (np.bitwise_or.reduce(watchdog.reshape(5, -1)) & Watchdog.FORCE).all()
    assert not (watchdog & Watchdog.GUARD).any()
