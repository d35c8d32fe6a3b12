"""Our robots and programs on the network with others by the real ROS 2 client library, in short.

In full: `BHD_TRIALS=full pytest tests/ros2/test_trials.py -k "avoidance or exactly_one"`: 12 min; `-k rule` and `-k
checkpoint`: 20 min each, 100 episodes.
"""

import itertools
import json
import math
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import binomtest

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.cli import record, train
from bhd_lerobot.cli.data.main import main as data
from tests.ros2.peer_env import Peer, environment
from tests.ros2.programs import Recording, Served, Side, log_of, newest_of, served
from tests.waiting import until

IS_FULL = os.environ.get("BHD_TRIALS") == "full"
WALL = ("--robot.arena=random", "--robot.seed=3")  # a wall 0.73 m ahead


def test_the_avoidance_node_drives_the_served_robot_without_contact(domain: int, tmp_path: Path) -> None:
    seconds = 600 if IS_FULL else 4
    with (
        Served("turtlebot3", *WALL, domain=domain, log=tmp_path / "log") as robot,
        Peer("avoidance_node.py", domain=domain) as driver,
    ):
        driver.wait(lambda line: line.get("scans", 0) >= 5 * seconds, f"{5 * seconds} scans")
        assert driver.stop() == 0
        assert robot.stop() == 0
    last = driver.lines[-1]
    assert last["turning"] > 0  # it has driven up to the wall
    assert last["without_reading"] == 0
    in_contact, ticks = robot.contacts
    assert in_contact == 0
    assert ticks > 100 * seconds


DRIVE = ("--task.type=free", "--task.instruction=drive", "--task.duration_s=3", "--brain.type=avoidance")
PILLAR = "--pose=0.0:-0.6:0"  # a pillar is 0.9 m ahead, to the left


def columns_of(root: Path) -> dict[str, np.ndarray]:
    table = pq.read_table(root / "data")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def outcomes_of(root: Path) -> list[str]:
    return [row["bhd/outcome"] for row in pq.read_table(root / "meta" / "episodes").to_pylist()]


def test_what_is_recorded_is_what_the_robot_measured_and_was_sent(domain: int, tmp_path: Path) -> None:
    log = tmp_path / "robot.jsonl"
    jumps = [f"--clock-jump={start}:{offset}" for start, offset in enumerate([3600, -7000] * 10, 3)]
    faults = ("--gap=scan:0.5:0.4", "--gap=joint_states:1.2:0.12", "--swap=joint_states:7", "--repeat=2", *jumps)
    options = ("--clock-offset=-86400", "--wait", "--log", log)
    with Peer("standin_turtlebot3.py", PILLAR, *options, *faults, domain=domain) as robot:
        robot.wait_event("ready")
        for attempt in range(3):
            folder = tmp_path / str(attempt)
            folder.mkdir()
            with Recording("turtlebot3", *DRIVE, "--dataset.num_episodes=2", domain=domain, folder=folder) as recording:
                if recording.process.wait() == 0:
                    break
                # On a busy machine the stand-in stands still for a third of a second: to us its wheels are blocked.
                # Or a message comes after one that was sent later, of another clock: to us its wheels turned back.
                assert any(one in recording.text for one in ("watchdog: blocked", "reads a change of")), recording.text
        assert recording.process.wait() == 0, recording.text
        until(lambda: robot.events("report")[-1]["command"] == [0.0, 0.0], "the robot stands")
    assert data(["check", str(recording.root)]) == 0
    columns = columns_of(recording.root)
    assert len(recording.starts) == 2
    times = np.array(recording.starts)[columns["episode_index"]] + columns["control.time"]
    state = columns["observation.state"]

    joints = log_of(log, "joints")
    speeds = np.array([line["speeds"] for line in joints])
    twists = np.stack([speeds.mean(axis=1), (speeds[:, 1] - speeds[:, 0]) / 0.160], axis=1)
    check_source(state[:, :2], times, twists, joints, atol=1e-6)
    scans = log_of(log, "scan")
    ranges = np.array([line["ranges"] for line in scans])
    used = check_source(state[:, 2:], times, np.where(ranges == 0, 3.5, ranges), scans, atol=1e-6)
    assert len(set(used)) > 10

    # The wheels' commands are sent at 50 Hz: what applied at the end of a frame lies between two that were sent.
    commands = log_of(log, "command")
    sent = np.array([line["monotonic"] for line in commands])
    given = np.array([line["given"] for line in commands])
    compared = 0
    for frame in range(len(times) - 1):
        near = given[(sent > times[frame + 1] - 0.1) & (sent < times[frame + 1] + 0.2)]
        if columns["episode_index"][frame] == columns["episode_index"][frame + 1] and len(near) >= 5:
            applied = columns["control.applied_action"][frame]
            assert (near.min(axis=0) - 1e-6 <= applied).all()
            assert (applied <= near.max(axis=0) + 1e-6).all()
            compared += 1
    assert compared > 10  # on a busy machine fewer commands are near
    assert given[:, 0].max() == pytest.approx(0.2)


def check_source(
    values: np.ndarray, times: np.ndarray, messages: np.ndarray, lines: list[dict[str, Any]], *, atol: float
) -> list[int]:
    """Check that each frame has the values of a message that was measured before its time, and that none goes back."""
    measured = np.array([line["monotonic"] for line in lines])
    used: list[int] = []
    for value, moment in zip(values, times, strict=True):
        equal = np.flatnonzero(np.isclose(messages, value, rtol=0, atol=atol).all(axis=1) & (measured <= moment))
        assert len(equal), f"no message before {moment} has {value[:4]}"
        used.append(int(equal[-1]))
    assert used == sorted(used)
    return used


KILLED = {  # a part of its command line, None for bhd-record itself; what is said of it
    "recording": (None, ""),
    "robot": ("", r"/\w+ has sent no message for|The wheels read"),  # whichever is noticed first
    "cerebellum": ("robots.host.process", "The cerebellum's process was killed by signal 9"),
    "node": ("ros2.live.process node", "The process of the ROS 2 node ended with status -9"),
}


@pytest.mark.parametrize("killed", KILLED)
@pytest.mark.thorough(but=1)
def test_whatever_is_killed_the_robot_stands_and_no_saved_episode_is_lost(killed, domain, tmp_path):
    part, cause = KILLED[killed]
    log = tmp_path / "robot.jsonl"
    with (
        Peer("standin_turtlebot3.py", "--open", "--log", log, domain=domain) as robot,
        Recording("turtlebot3", *DRIVE, "--dataset.num_episodes=9", domain=domain, folder=tmp_path) as recording,
    ):
        recording.wait_for_episode(2)
        until(lambda: newest_of(log, "pose")["twist"][0] > 0.1, "the robot moves")
        if killed == "robot":
            robot.signal(signal.SIGKILL)
        else:
            os.kill(recording.pid if part is None else recording.pid_of(part), signal.SIGKILL)
            killed_at = time.monotonic()
            until(lambda: newest_of(log, "pose")["twist"] == [0.0, 0.0], "the robot stands")
            assert time.monotonic() - killed_at < 20  # not because the brain was silent for so long
        assert recording.process.wait() != 0
        if part is not None:
            assert re.search(cause, recording.text)
    if killed == "recording":
        assert data(["repair", str(recording.root)]) == 0
    outcomes = outcomes_of(recording.root)
    assert outcomes[0] == "timeout"
    assert set(outcomes[1:-1]) <= {"timeout"}
    assert outcomes[-1] in ("timeout", "fault")
    assert data(["check", str(recording.root)]) == 0


HOME = (0.4869, 0.10915, 0.281859)  # of the UR5's tool in its base frame [m]
DOWN = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # x, y, z, w


def goal(*position: float, orientation: tuple[float, ...] = DOWN) -> str:
    return "--goal=" + ",".join(map(str, (*position, *orientation)))


ASIDE = (HOME[0], HOME[1] + 0.1, HOME[2])
FLOATS = "std_msgs/msg/Float64MultiArray"
REACHED = "The target is reached."
NAMES = itertools.count()


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    environment(messages=True)
    yield from served("ur5", tmp_path_factory.mktemp("arm"), "--state_hz=40")


@pytest.fixture
def talk(arm: Side) -> Callable[..., list[tuple[bool, str]]]:
    """Return a function that sends goals as the articles' brain does, and returns the one result of each."""

    def send(*options: str, name: str = "") -> list[tuple[bool, str]]:
        name, domain = name or f"brain-{next(NAMES)}", arm.node.network.domain_number
        with Peer("brain_node.py", f"--name={name}", "--linger=0.3", *options, domain=domain) as peer:
            summary = peer.wait_event("summary")
            results = sorted(peer.events("result"), key=lambda line: line["task_id"])
        counts = {key: summary[key] for key in ("once", "twice", "never", "unknown")}
        assert counts == {"once": summary["sent"], "twice": 0, "never": 0, "unknown": 0}
        return [(line["success"], line["message"]) for line in results]

    return send


def test_each_goal_of_a_brain_gets_exactly_one_result_and_the_state_has_its_rate(arm, talk):
    bad = {
        goal(3.0, 0.0, 0.3): "too far away",
        goal(math.nan, 0.0, 0.3): "must be finite",
        goal(*HOME, orientation=(0.0, 0.0, 0.0, 0.0)): "norm of the quaternion",
    }
    first, *refused, last = talk(goal(*ASIDE), *bad, goal(*HOME), name="first")
    assert first == last == (True, REACHED)
    for (success, message), why in zip(refused, bad.values(), strict=True):
        assert not success
        assert why in message
    for _ in range(10 if IS_FULL else 1):  # of the same names again
        assert talk(goal(*ASIDE), *bad, goal(*HOME), name="first") == [first, *refused, last]
    [(success, message)] = talk(goal(*ASIDE), "--frame=map")
    assert not success
    assert "'map'" in message
    assert talk(goal(*ASIDE), goal(*HOME), "--preempt=0.1") == [(True, REACHED)] * 2  # the second waits
    slowly = ("--name=slow", "--max-velocity=0.01", "--linger=0.3")
    with Peer("brain_node.py", goal(*ASIDE), *slowly, domain=arm.node.network.domain_number) as brain:
        brain.wait_event("command")
        arm.wait(lambda state: state.is_moving, "it moves")
        arm.send("/forward_position_controller/commands", FLOATS, {"data": np.array([ur5().arm.home[:6]])})
        summary = brain.wait_event("summary")
    assert (summary["once"], summary["twice"]) == (1, 0)
    states: list[Any] = []
    until(lambda: [states.extend(one.message() for one in arm.states.take()), len(states) > 40][1], "forty states")
    stamps = np.array([one.header.stamp.sec * 10**9 + one.header.stamp.nanosec for one in states])
    assert np.median(np.diff(stamps)) == pytest.approx(1e9 / 40, rel=0.1)
    assert "A setpoint came" in brain.events("result")[0]["message"]


STOPPED = {  # what happens to the driver or to a process of ours; what is printed of it
    "protective stop": (("--on-usr1=safety:3",), "its safety status is STOPPED"),
    "emergency stop": (("--on-usr1=safety:7",), r"Emergency stop \(the robot's own\)"),
    # A reading whose message came late is too old before its successor is missed.
    "silence": (("--on-usr1=silence",), r"/joint_states has sent no message for|the newest reading was \d"),
    "node": ((), "The process of the ROS 2 node ended with status -9"),
    "cerebellum": ((), "The cerebellum's process was killed by signal 9"),
}


@pytest.mark.parametrize("what", STOPPED)
@pytest.mark.thorough
def test_an_arm_that_stops_or_is_left_alone_stands_and_the_episode_names_the_cause(what, domain, tmp_path):
    options, cause = STOPPED[what]
    log = tmp_path / "robot.jsonl"
    move = ("--task.type=free", "--task.instruction=move", "--task.duration_s=2", "--brain.type=random")
    environment(messages=True)
    with Peer("ur_driver_standin.py", "--log", log, *options, domain=domain) as robot:
        robot.wait_event("ready")
        # However late the commands come, as on a loaded machine, an arm that follows is not blocked.
        given = (*move, "--brain.scale=0.02", "--dataset.num_episodes=9", "--robot.ros2.latency_s=1")
        silence_s = 0.4 if what == "silence" else 5
        with Recording("ur5", *given, domain=domain, folder=tmp_path, silence_s=silence_s) as recording:
            recording.wait_for_episode(2)
            until(lambda: np.ptp([line["position"] for line in log_of(log, "state")], axis=0).max() > 0.01, "it moves")
            if options:
                robot.signal(signal.SIGUSR1)
            else:
                process = {"node": "ros2.live.process node", "cerebellum": "robots.host.process"}[what]
                os.kill(recording.pid_of(process), signal.SIGKILL)
            assert recording.process.wait() != 0
            assert re.search(cause, recording.text)
        before = newest_of(log, "state")
        until(lambda: newest_of(log, "state")["monotonic"] > before["monotonic"] + 0.5, "time passes")
        assert newest_of(log, "state")["position"] == pytest.approx(before["position"], abs=1e-3)
    assert data(["check", str(recording.root)]) == 0
    first, *rest = outcomes_of(recording.root)
    assert first == "timeout"
    assert rest in ([], ["fault"], ["estop"])


FULL_S, SHORT_S = 10, 4  # of an episode


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", ["rule", "checkpoint"])
@pytest.mark.thorough
def test_a_brain_does_over_ros_what_it_does_in_this_process(kind: str, domain: int, tmp_path: Path) -> None:
    episodes, seconds = (100, FULL_S) if IS_FULL else (2, SHORT_S)
    brain = ("--brain.type=avoidance",)
    if kind == "checkpoint":
        brain = ("--brain.type=learned", f"--brain.path={imitate_the_rule(tmp_path)}")
    task = (
        *("--task.type=avoid", "--task.arena=turtlebot3_world", "--task.random_start=true", "--task.min_path_m=0.3"),
        *(f"--task.duration_s={seconds}", *brain, f"--dataset.num_episodes={episodes}"),
    )
    alone = tmp_path / "alone"
    here = ("--robot.type=turtlebot3", "--dataset.repo_id=test/alone", "--preview_video=false")
    assert record.main([*here, f"--dataset.root={alone}", f"--output_dir={tmp_path / 'here'}", *task]) == 0
    with Served("turtlebot3", "--robot.arena=turtlebot3_world", domain=domain, log=tmp_path / "robot") as robot:
        with Recording("turtlebot3", *task, domain=domain, folder=tmp_path) as recording:
            assert recording.process.wait() == 0, recording.text
        assert robot.stop() == 0
    (low, high), (ros_low, ros_high) = (_success(outcomes_of(root)) for root in (alone, recording.root))
    in_contact, ticks = robot.contacts
    ages = columns_of(recording.root)["control.age"]
    print(f"Success in this process {low:.3f} to {high:.3f}, over ROS {ros_low:.3f} to {ros_high:.3f}.")
    print(f"In contact over ROS: {in_contact} of {ticks} control ticks.")
    print(f"Age of an observation [s]: p50 {np.median(ages):.3f}, p99 {np.percentile(ages, 99):.3f}.")
    assert in_contact == 0 or kind == "checkpoint"
    assert low <= ros_high
    assert ros_low <= high
    timing = json.loads(pq.read_table(recording.root / "meta" / "episodes").to_pylist()[0]["bhd/timing"])
    assert timing["age_max"] > 0
    assert timing["inference_p99"] > 0


def imitate_the_rule(tmp_path: Path) -> Path:
    """Return a checkpoint that was trained on what the rule does."""
    dataset, folder = f"--dataset.root={tmp_path / 'rule'}", tmp_path / "checkpoint"
    size, learning = ((200, 32), ()) if IS_FULL else ((4, 4), ("--steps=100", "--eval_steps=0"))
    some = (f"--dataset.num_episodes={size[0]}", f"--n_envs={size[1]}", f"--output_dir={tmp_path / 'run'}")
    recipe = "--config_path=configs/{}_avoid.yaml"
    assert record.main([recipe.format("record/turtlebot3"), dataset, *some, "--preview_video=false"]) == 0
    assert train.main([recipe.format("train/bc_turtlebot3"), dataset, f"--output_dir={folder}", *learning]) == 0
    return folder


def _success(outcomes: list[str]) -> tuple[float, float]:
    """Return the 95 % interval of the rate of success."""
    found = binomtest(outcomes.count("success"), len(outcomes)).proportion_ci(method="wilson")
    return found.low, found.high
