"""How a command begins: Ctrl-C while Python imports what it needs, and what becomes of memory that it frees."""

import ctypes
import importlib
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from bhd_lerobot.cli import start
from bhd_lerobot.cli.data import main

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]


def started(folder: Path, program: str, *, ignored: bool = False) -> subprocess.CompletedProcess:
    """Run a module that interrupts itself as the console scripts run ours."""
    (folder / "slow.py").write_text(program)
    how = "signal.SIG_IGN" if ignored else "signal.default_int_handler"
    command = f"import signal, sys; signal.signal(signal.SIGINT, {how}); import bhd_lerobot.cli.start as s; "
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, "-c", command + "sys.exit(s.run('slow'))"],
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


INTERRUPT = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"


@pytest.mark.parametrize(
    "program",
    [
        f"try:\n    {INTERRUPT.replace(chr(10), chr(10) + '    ')}pass\nexcept BaseException:\n    pass\n",
        f"{INTERRUPT}raise AssertionError('it went on')\n",
        f"def main():\n    with s.loading():\n        exec({INTERRUPT!r} + 'raise AssertionError()')\n",
    ],
    ids=["in a library that catches everything", "in an import", "in an import of a command that runs"],
)
def test_ctrl_c_during_an_import_is_a_line_and_status_130(tmp_path: Path, program: str) -> None:
    if "def main" not in program:
        program += "def main():\n    raise AssertionError('it went on')\n"
    done = started(tmp_path, "import bhd_lerobot.cli.start as s\n" + program)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (130, "", 1)
    assert done.stderr.startswith("Stopped before it began")


def test_ctrl_c_afterwards_is_handled_by_the_program_or_else_a_line(tmp_path: Path) -> None:
    own = f"def main():\n    try:\n        {INTERRUPT.replace(chr(10), chr(10) + '        ')}pass\n"
    done = started(tmp_path, own + "    except KeyboardInterrupt:\n        return 7\n")
    assert (done.returncode, done.stderr) == (7, "")
    done = started(tmp_path, f"def main():\n    {INTERRUPT.replace(chr(10), chr(10) + '    ')}return 0\n")
    assert (done.returncode, done.stderr) == (130, "Stopped.\n")


def test_ctrl_c_while_the_process_ends_is_no_traceback(tmp_path: Path) -> None:
    at_exit = "import atexit, os, signal\natexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
    done = started(tmp_path, f"{at_exit}def main():\n    print('done', flush=True)\n    return 0\n")
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "done\n", "")


def test_where_ctrl_c_is_ignored_it_stays_ignored(tmp_path: Path) -> None:
    done = started(tmp_path, f"{INTERRUPT}def main():\n    return 5\n", ignored=True)
    assert (done.returncode, done.stderr) == (5, "")


def test_threads_that_wait_sleep_unless_the_environment_sets_another_policy(tmp_path, monkeypatch):
    program = "import os\nvalue = os.environ['OMP_WAIT_POLICY']\ndef main():\n    print(value)\n    return 0\n"
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert started(tmp_path, program).stdout == "PASSIVE\n"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert started(tmp_path, program).stdout == "ACTIVE\n"


@pytest.mark.parametrize("script", sorted(SCRIPTS))
def test_every_command_begins_this_way(script: str) -> None:
    place, _, name = SCRIPTS[script].partition(":")
    begin = getattr(start, name)
    assert (place, begin.func) == ("bhd_lerobot.cli.start", start.run)
    assert callable(importlib.import_module(*begin.args).main)


@pytest.mark.law
def test_every_command_names_the_nearest_option_with_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    for module, arguments in (
        ("cli.record", ["--sed=1"]),
        ("cli.evaluate", ["--sed=1"]),
        ("cli.replay", ["--mod=state"]),
        ("cli.train", ["--stepz=1"]),
        ("cli.data.main", ["check", "--jsonn"]),
        ("cli.data.main", ["chek"]),
        ("cli.monitor", ["--oncee"]),
        ("cli.doctor", ["--jsonn"]),
        ("cli.ros2", ["topics", "list", "--domian=1"]),
        ("cli.ros2", ["topics", "lst"]),
    ):
        try:
            status = importlib.import_module(f"bhd_lerobot.{module}").main(arguments)
        except SystemExit as end:
            status = end.code
        assert (status, "Did you mean" in capsys.readouterr().err) == (2, True), module


def loaded(program: str) -> list[set[str]]:
    """Return the modules that a new interpreter has loaded at each call of `show` in a program."""
    show = "import sys; show = lambda: print('@', *sys.modules, file=sys.stderr)\n"
    done = subprocess.run(
        [sys.executable, "-c", show + program], capture_output=True, text=True, check=True, cwd=ROOT,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return [set(line.split()[1:]) for line in done.stderr.splitlines() if line.startswith("@ ")]


def test_nothing_slow_is_imported_before_ctrl_c_is_handled_and_for_the_help() -> None:
    before, to_watch, for_help = loaded(
        "import bhd_lerobot.cli.start, bhd_lerobot.cli.data.main as data; show()\n"
        "import bhd_lerobot.cli.monitor; show()\n"
        "try: data.main(['--help'])\nexcept SystemExit: show()"
    )
    slow = {"torch", "lerobot", "mujoco", "huggingface_hub", "rosbags", "av", "PIL"}
    assert not before & {*slow, "numpy", "rich", "yaml", "pyarrow"}
    assert not to_watch & slow
    assert not for_help & {*slow, "pandas", "pinocchio", "matplotlib", "ray"}


def test_help_and_errors_load_neither_networks_nor_physics_nor_datasets_nor_charts() -> None:
    commands = [
        ("record", "--help"), ("record", "--robot.type=turtelbot"), ("record", "--config_path=there_is_none.yaml"),
        ("evaluate", "--help"), ("evaluate", "--sed=1"), ("replay", "--help"), ("replay", "--mode=stat"),
        ("ros2", "serve", "--help"), ("ros2", "bridge", "--robot.type=ur"),
        ("train", "--config_path=there_is_none.yaml"),
    ]  # fmt: skip
    program = "from bhd_lerobot.cli import start\n"
    for module, *arguments in commands:
        program += f"sys.argv[1:] = {arguments}; start.run('bhd_lerobot.cli.{module}'); show()\n"
    slow = {"torch", "torchvision", "transformers", "diffusers", "pandas", "matplotlib", "deepdiff", "datasets", "av"}
    slow |= {"lerobot.datasets", "pyarrow", "mujoco", "numba", "pinocchio", "scipy.interpolate"}
    found = loaded(program)
    assert len(found) == len(commands)
    for command, packages in zip(commands, found, strict=True):
        assert not packages & slow, command


def test_a_recording_of_a_simulation_needs_no_pytorch(tmp_path: Path) -> None:
    options = ["--robot.type=turtlebot3", "--brain.type=avoidance", "--task.type=free", "--task.instruction=drive"]
    options += ["--task.duration_s=1", "--dataset.num_episodes=1", "--dataset.repo_id=test/light"]
    options += [f"--dataset.root={tmp_path / 'light'}", f"--output_dir={tmp_path / 'run'}"]
    program = f"import sys; sys.argv[1:] = {options}; from bhd_lerobot.cli import start; assert start.record() == 0"
    program += "; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT, stdin=subprocess.DEVNULL)
    assert len(list((tmp_path / "light" / "data").rglob("*.parquet"))) == 1


def test_lerobots_packages_are_what_they_were_once_they_are_needed() -> None:
    program = """
import sys
from bhd_lerobot.stock import defer_packages
defer_packages()
import lerobot.robots.config
assert "torch" not in sys.modules
from lerobot.robots import Robot, make_robot_from_config
from lerobot.utils import constants
from lerobot.robots import *
import lerobot.robots as package
assert "torch" in sys.modules
assert Robot is sys.modules["lerobot.robots.robot"].Robot and "Robot" in package.__all__
try:
    package.nobody
except AttributeError as error:
    assert "'lerobot.robots' has no attribute 'nobody'" in str(error)
"""
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT, stdin=subprocess.DEVNULL)


def test_the_handler_before_comes_back() -> None:
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with start.leaving_on_interrupt():
            assert signal.getsignal(signal.SIGINT) is start._leave
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with pytest.raises(SystemExit):
            main.main(["--help"])
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, former)


def run_unread(*arguments: str) -> subprocess.CompletedProcess:
    """Run Python with an output that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as output:
        command = [sys.executable, *arguments]
        return subprocess.run(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.PIPE, check=False
        )


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("command", ["bhd-record", "bhd-data"])
def test_help_that_nobody_reads_to_its_end_ends_without_output(command: str) -> None:
    """As of ``--help | head``; bhd-data has tests of its other output."""
    module, _, function = SCRIPTS[command].partition(":")
    program = f"import sys; sys.argv = [{command!r}, '--help']; import {module} as m; sys.exit(m.{function}())"
    done = run_unread("-c", program)
    assert done.returncode in (0, 128 + signal.SIGPIPE)
    assert b"Traceback" not in done.stderr


_FAULTS = """
import resource
import numpy as np
from bhd_lerobot.cli.start import keep_memory

def faults():  # where freed memory lies has settled after a few rounds
    counts = []
    for _ in range(12):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        np.empty(64 << 20, np.uint8).fill(1)
        counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    return sum(counts[6:])

fetched = faults()
keep_memory()
print(fetched, faults())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="the C library has no mallopt")
def test_memory_that_a_batch_took_is_there_for_the_next() -> None:
    ran = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True, cwd=ROOT)
    fetched, kept = map(int, ran.stdout.split())
    assert kept < fetched / 10
