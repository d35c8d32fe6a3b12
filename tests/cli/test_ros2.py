"""`bhd-ros2 topics`, with a robot in a second process."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from bhd_lerobot.cli.ros2 import main
from bhd_lerobot.ros2.live.topics import Intervals
from tests.ros2.peer_env import free_domain
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]
ROBOT = """
import sys, time
import numpy as np
from bhd_lerobot.ros2.live.network import LATCHED, SENSOR_DATA, NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.messages.serialize import encode_one

LASER, TEXT = "sensor_msgs/msg/LaserScan", "std_msgs/msg/String"
OWN, OTHER = "own_msgs/msg/Own", "own_msgs/msg/Other"
register_types({OWN: "int32 number", OTHER: "int32 number"})
with Node("robot", NetworkConfig(domain=int(sys.argv[1]))) as node:
    scan, own = node.publisher("/scan", LASER, SENSOR_DATA), node.publisher("/own", OWN)
    name, hidden = node.publisher("/name", TEXT, LATCHED), node.publisher("/a/_action/feedback", TEXT)
    others = node.subscription("/scan", LASER), node.subscription("/scan", TEXT, SENSOR_DATA)
    other = node.publisher("/other", OTHER)
    cmd = node.subscription("/cmd", TEXT)
    name.send(encode_one(TEXT, {"data": "burger"}))
    scan_data = encode_one(LASER, {"header": {"frame_id": "base_scan"}, "ranges": np.linspace(0.1, 3.6, 360)})
    print("ready", flush=True)
    while True:
        scan.send(scan_data)
        own.send(encode_one(OWN, {"number": 5}))
        time.sleep(0.02)
"""


@pytest.fixture(scope="module")
def robot() -> Iterator[list[str]]:
    with free_domain() as domain:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", ROBOT, str(domain)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield [f"--domain={domain}", "--wait=60"]
            process.kill()


@pytest.fixture
def run(robot: list[str], capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    def run(command: str, *arguments: str) -> tuple[int, str]:
        status = main(["topics", command, *robot, *arguments])
        return status, capsys.readouterr().out

    return run


def test_list_names_types_nodes_and_what_does_not_fit(run: Callable) -> None:
    # What is found in a second depends on how busy the machine is.
    printed = until(
        lambda: (found := run("list", "--wait=1"))[1].count("mismatch") == 2 and found[1], "both mismatches"
    )
    lines = printed.splitlines()
    assert "/scan  sensor_msgs/msg/LaserScan, std_msgs/msg/String" in lines
    assert "  publisher     /robot  best effort" in lines
    assert "  mismatch: /robot publishes best effort, /robot wants reliable; no message passes." in lines
    kinds = "/robot publishes sensor_msgs/msg/LaserScan, /robot subscribes to std_msgs/msg/String."
    assert f"  mismatch: {kinds}" in lines
    assert "_action" not in printed
    until(lambda: "/a/_action/feedback" in run("list", "--all", "--wait=1")[1], "a topic of an action")


def test_echo_prints_yaml_with_long_arrays_shortened(run: Callable) -> None:
    status, printed = run("echo", "scan", "-n", "2")
    first, second, end = yaml.safe_load_all(printed)
    assert (status, end) == (0, None)
    assert first == second
    assert first["header"]["frame_id"] == "base_scan"
    assert first["ranges"][:1] == [0.1]
    assert first["ranges"][-1] == "352 more"
    assert run("echo", "/scan", "-n", "1", "--field", "ranges.359") == (0, "3.6\n---\n")
    assert run("echo", "/name", "-n", "1") == (0, "data: burger\n---\n")  # sent before the subscription


def test_hz_prints_a_rate_and_ctrl_c_ends_it_with_a_summary(run: Callable, robot: list[str]) -> None:
    status, printed = run("hz", "/scan", "--seconds", "2.5")
    assert (status, printed.splitlines()[-1][:5]) == (0, "all: ")
    command = [sys.executable, "-m", "bhd_lerobot.cli.ros2", "topics", "hz", "/scan", *robot]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        assert " Hz; interval: mean " in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert "all: " in process.stdout.read()
    assert process.returncode == 0


def test_a_window_forgets_what_is_older() -> None:
    intervals = Intervals(1.0)
    assert intervals.of_window(5.0) == "no message yet"
    for time in (0.0, 2.0, 2.5):
        intervals.add(time)
    assert intervals.of_window(2.5).endswith("2 messages")
    assert intervals.of_window(5.0) == "no message for 2.5 s"
    assert intervals.of_all().endswith("3 messages")


def test_types_of_others_are_defined_in_a_mapping(run: Callable, tmp_path: Path) -> None:
    mapping = tmp_path / "map.yaml"
    mapping.write_text("types:\n  own_msgs/msg/Own: int32 number\n")
    assert run("echo", "/own", "-n", "1", f"--map={mapping}") == (0, "number: 5\n---\n")


def test_what_cannot_be_shown_is_named(robot: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["hz", "/scn", "--wait=1"], "Did you mean '/scan'?"),
        (["echo", "/other"], "Unknown ROS 2 type 'own_msgs/msg/Other'."),
        (["echo", "/cmd", "--wait=1"], "Nobody publishes /cmd"),
        (["echo", "/scan", "--field=heder"], "Did you mean 'header'?"),
        (["echo", "/scan", "--field=header.stamp.sec.x"], "there is no 'x' in what has no fields"),
        (["echo", "/scan", "-n", "0"], "-n is 0; it must be at least 1"),
        (["hz", "/scan", "--window=-1"], "--window is -1.0; it must be positive"),
        (["list", "--distro=jazy"], "Did you mean 'jazzy'?"),
        (["list", "--interface=nothing0"], "The network interface 'nothing0' cannot be used"),
    ):
        assert main(["topics", arguments[0], *robot, *arguments[1:]]) == 2
        assert said in capsys.readouterr().err


def test_a_domain_with_nobody_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with free_domain() as domain:
        for command in (["list"], ["echo", "/scan"]):
            assert main(["topics", *command, f"--domain={domain}", "--wait=0.5"]) == 2
            assert f"Nobody is in ROS domain {domain} on 'lo', after 0.5 s." in capsys.readouterr().err


def test_without_cyclonedds_the_command_that_installs_it_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cyclonedds.core", None)
    assert main(["topics", "list"]) == 2
    assert "pip install -e '.[ros2]'" in capsys.readouterr().err
