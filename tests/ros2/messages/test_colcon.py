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
    """Make an environment with ROS and colcon, whose wheels find this Python, and whose programs its final place."""
    peer_env._install(REQUIREMENTS, folder)
    final, (site, *_) = folder.with_suffix(""), folder.glob("lib/python*/site-packages")
    changes = {
        f"{WHEELS}/include/python3.12": sysconfig.get_path("include"),
        f"{WHEELS}/lib/python3.12/site-packages": str(final / site.relative_to(folder)),
        str(folder): str(final),
    }
    for file in (*(folder / "share").rglob("*.cmake"), *(one for one in (folder / "bin").iterdir() if one.is_file())):
        data = before = file.read_bytes()
        for there, here in changes.items() if file.suffix == ".cmake" or data.startswith(b"#!") else ():
            data = data.replace(there.encode(), here.encode())
        if data != before:
            mode = file.stat().st_mode
            file.unlink()  # it may be linked into the installer's cache, from which the next environment is made
            file.write_bytes(data)
            file.chmod(mode)


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
    folders = [f"--{name}-base={tmp_path / name}" for name in ("build", "install")]
    colcon = [home / "bin/colcon", f"--log-base={tmp_path / 'log'}", "build", f"--base-paths={tmp_path / 'src'}"]
    peer_env._run([*colcon, *folders, "--cmake-args", f"-DPython3_EXECUTABLE={python}"], variables)
    [packages] = made.glob("lib/python*/site-packages")
    found = {"AMENT_PREFIX_PATH": f"{made}:{home}", "LD_LIBRARY_PATH": str(made / "lib"), "PYTHONPATH": str(packages)}
    peer_env._run([python, "-c", USE], variables | found)
