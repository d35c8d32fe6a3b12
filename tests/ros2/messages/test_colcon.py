"""The package of our messages: colcon builds it as it is, for real `rclpy`."""

import os
import shutil
import sysconfig
from pathlib import Path

import pytest

from tests.requirements import not_tested
from tests.ros2 import peer_env

REQUIREMENTS = peer_env.HERE / "requirements-colcon.txt"
WHEELS = "/opt/python/cp312-cp312"  # the Python that the wheels were built with, which they name in their CMake files
USE = """
from rclpy.serialization import deserialize_message, serialize_message
from bhd_interfaces.msg import BrainCommand, BrainResult, CerebellumState
made = CerebellumState(joint_positions=[1.0, 2.0], is_moving=True), BrainResult(success=True), BrainCommand(task_id="a")
assert all(deserialize_message(serialize_message(one), type(one)) == one for one in made)
"""


def install(folder: Path) -> None:
    """Make an environment with ROS and colcon, whose wheels find this Python."""
    peer_env._install(REQUIREMENTS, folder)
    [site] = folder.glob("lib/python*/site-packages")
    here = {
        f"{WHEELS}/include/python3.12": sysconfig.get_path("include"),
        f"{WHEELS}/lib/python3.12/site-packages": site,
    }
    for file in (folder / "share").rglob("*.cmake"):
        text = file.read_text("utf-8")
        if WHEELS in text:
            for there, path in here.items():
                text = text.replace(f"{WHEELS}/{there}", str(path))
            file.write_text(text, "utf-8")


@pytest.mark.thorough
@pytest.mark.timeout(1200)
def test_colcon_builds_the_package_of_our_messages_as_it_is(tmp_path: Path) -> None:
    try:
        home = peer_env._made("colcon", [REQUIREMENTS, REQUIREMENTS.with_name("requirements-kilted.txt")], install)
    except peer_env.UnavailableError as error:
        not_tested(f"the build of our messages by colcon; {error}")
    python, made = home / "bin/python", tmp_path / "install/bhd_interfaces"
    shutil.copytree(peer_env.MESSAGES["bhd_interfaces"], tmp_path / "src/bhd_interfaces")
    variables = peer_env.RosEnvironment(python, None).variables(0)
    variables |= {"PATH": f"{home / 'bin'}:{os.environ['PATH']}", "CMAKE_PREFIX_PATH": str(home)}
    variables["AMENT_PREFIX_PATH"] = str(home)
    folders = [
        f"--{name}={tmp_path / folder}" for name, folder in (("build-base", "build"), ("install-base", "install"))
    ]
    command = ["colcon", f"--log-base={tmp_path / 'log'}", "build", f"--base-paths={tmp_path / 'src'}", *folders]
    peer_env._run([*command, "--cmake-args", f"-DPython3_EXECUTABLE={python}"], variables)
    [packages] = made.glob("lib/python*/site-packages")
    found = {"AMENT_PREFIX_PATH": f"{made}:{home}", "LD_LIBRARY_PATH": str(made / "lib"), "PYTHONPATH": str(packages)}
    peer_env._run([python, "-c", USE], variables | found)
