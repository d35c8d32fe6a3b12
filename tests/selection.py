"""Which tests run: by `--quick`, by `--thorough`, and by the mark `wall_clock`.

Tests of real-time processes, ROS, terminals and robots of others mostly wait. They run apart from those that keep the
processors busy (`python -m tests`), and none asserts how long something took.
"""

import subprocess
from collections import Counter
from pathlib import Path

import pytest

from tests.arrows import ARROWS, PACKAGE, ROOT

TESTS = ROOT / "tests"
WALL_CLOCK = (
    "apps/doctor/",
    "apps/monitor/",
    "benchmarks/test_realtime.py",
    "cli/test_ros2.py",
    "evaluation/test_operator.py",
    "examples/test_network_arm.py",
    "policies/teleop/",
    "policies/topic/",
    "realtime/",
    "recording/test_live_record.py",
    "recording/test_person.py",
    "recording/test_reset.py",
    "robots/device/",
    "robots/external/",
    "robots/host/",
    "robots/viewer/",
    "rollout/test_episode.py",
    "rollout/test_marks.py",
    "ros2/bag/player/",
    "ros2/bag/recorder/",
    "ros2/live/",
    "ros2/robots/",
    "ros2/serve/",
    "ros2/test_",
    "teleoperators/",
)
_mirrors: set[Path] = set()
"""The folders and files of tests that mirror what has changed."""
_packages: set[str] = set()
"""The packages whose laws the run includes."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--thorough",
        choices=("no", "only", "all"),
        default="all",
        help="leave out the tests marked thorough, as `make test` does; run only them; or all (the default)",
    )
    parser.addoption(
        "--quick",
        choices=("all", "changed"),
        help="run only the tests marked law: all of them; or those that the changes since the last commit touch, and "
        "every test that mirrors these changes",
    )


def pytest_configure(config: pytest.Config) -> None:
    global _mirrors, _packages
    if config.getoption("--quick") == "changed":
        _mirrors, _packages = concerned(changed_files())
    else:
        _mirrors, _packages = set(), set(ARROWS)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no module that nothing is run of: importing all of them takes longer than what `--quick` runs."""
    if not collection_path.match("test_*.py"):
        return None
    part = config.getoption("markexpr")
    if part in ("wall_clock", "not wall_clock") and is_timed(collection_path) != (part == "wall_clock"):
        return True
    if not config.getoption("--quick") or is_mirror(collection_path):
        return None
    states_law = "pytest.mark.law" in collection_path.read_text(encoding="utf-8")
    package = package_of(collection_path.parent)
    return None if states_law and (package in _packages or (not package and _packages)) else True


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if is_timed(item.path):
            item.add_marker(pytest.mark.wall_clock)
    chosen = [item for item in items if _is_quick(config, item)]
    if (wanted := config.getoption("--thorough")) != "all":
        thorough = _thorough(chosen)
        chosen = [item for item in chosen if (item in thorough) == (wanted == "only")]
    if len(chosen) < len(items):
        kept = set(chosen)
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = chosen


def _is_quick(config: pytest.Config, item: pytest.Item) -> bool:
    return not config.getoption("--quick") or item.get_closest_marker("law") is not None or is_mirror(item.path)


def _thorough(items: list[pytest.Item]) -> set[pytest.Item]:
    """Return the tests marked thorough; of one marked `thorough(but=n)` the first n examples are not."""
    examples: Counter[str] = Counter()
    found = set()
    for item in items:
        name = item.nodeid.partition("[")[0]
        examples[name] += 1
        marker = item.get_closest_marker("thorough")
        if marker is not None and examples[name] > marker.kwargs.get("but", 0):
            found.add(item)
    return found


def is_timed(path: Path) -> bool:
    """Tell whether the tests of a file are of the wall clock."""
    return path.relative_to(TESTS).as_posix().startswith(WALL_CLOCK)


def is_mirror(path: Path) -> bool:
    """Tell whether a file of tests mirrors something that has changed."""
    return path in _mirrors or path.parent in _mirrors


def changed_files() -> set[Path]:
    """Return the files that differ from the last commit or are new."""
    files: set[Path] = set()
    for command in (("diff", "--name-only", "HEAD"), ("ls-files", "--others", "--exclude-standard")):
        listed = subprocess.run(("git", *command), cwd=ROOT, check=True, capture_output=True, text=True)
        files.update(ROOT / line for line in listed.stdout.splitlines())
    return files


def package_of(folder: Path) -> str:
    """Return the package that a folder of the package or of the tests belongs to; "" beside all packages."""
    root = TESTS if folder.is_relative_to(TESTS) else ROOT / PACKAGE
    name = ".".join(folder.relative_to(root).parts)
    while name and name not in ARROWS:
        name = name.rpartition(".")[0]
    return name


def importers(packages: set[str]) -> set[str]:
    """Return these packages and those that may import one of them, over others too."""
    found = set(packages)

    def reaches(allowed: str) -> bool:
        any_below = allowed.endswith("*")
        return any(f"{one}.".startswith(allowed[:-1]) if any_below else allowed.startswith(one) for one in found)

    while more := {name for name, arrows in ARROWS.items() if name not in found and any(map(reaches, arrows))}:
        found |= more
    return found


def concerned(files: set[Path]) -> tuple[set[Path], set[str]]:
    """Return the folders and files of tests that mirror the changed files, and the packages whose laws they touch.

    What lies outside of the package and its tests, such as the list of dependencies, touches every law.
    """
    mirrors: set[Path] = set()
    packages: set[str] = set()
    for file in files:
        if file.is_relative_to(TESTS) and (file.parent != TESTS or file.name.startswith("test_")):
            mirrors.add(file if file.name.startswith("test_") else file.parent)
        elif file.is_relative_to(ROOT / PACKAGE) and file.suffix == ".py":
            package = package_of(file.parent) or file.stem
            mirrors.add(TESTS.joinpath(*package.split(".")))
            packages.add(package)
        elif file.suffix != ".md":
            packages |= ARROWS.keys()
    return mirrors, importers(packages)
