"""The rules of the packages that no other test would notice: who may import whom, and what a file may not contain.

A new package, or a new arrow between two, is a change to `arrows.py` or the tables below, and so to the design.
"""

import ast
import functools
import os
import re
import subprocess
from pathlib import Path

import pytest

from tests import selection
from tests.arrows import ARROWS, EVERYTHING, PACKAGE, ROOT
from tests.cases import each_case

MOST_FILES = 15
SOURCE = ROOT / PACKAGE

# third-party package -> the only packages of ours that may import it, and those that may not, by the first name.
ONLY_IN = {"mujoco": ("sim",)}
NEVER_IN = {
    "torch": ("options", "bodies", "sim", "control", "realtime"),
    "lerobot": ("errors", "options", "bodies", "sim", "control", "realtime", "tasks"),
    "mujoco": ("options", "bodies", "control", "realtime"),
}
# The bodies of our two robots, and what may know them: their configurations, presets and defaults. Others ask a `Body`.
OWN_BODIES = ("bodies.so101", "bodies.turtlebot3", "bodies.turtlebot3_manipulation", "bodies.ur")
OF_OWN_BODIES = {
    *(
        "robots.config_arm",
        "robots.config_mobile_arm",
        "robots.config_turtlebot3",
        "robots.config_ur",
    ),
    *("ros2.messages.presets", "ros2.messages.robot_views", "cli.data.import_bag"),
    *("teleoperators.config_bhd_keyboard_base", "policies.cnn.configuration_cnn"),
}
# What of LeRobot is made for plug-ins; everything else moves from version to version, and only `stock` imports it.
LEROBOT_MODULES = (
    *(
        "lerobot.cameras",
        "lerobot.configs",
        "lerobot.envs.configs",
        "lerobot.lerobot_types",
        "lerobot.optim.schedulers",
    ),
    *("lerobot.policies.pretrained", "lerobot.robots.config", "lerobot.robots.robot", "lerobot.teleoperators"),
    *("lerobot.utils.constants", "lerobot.utils.errors"),
)
LEROBOT_PACKAGES = ("lerobot.optim", "lerobot.policies", "lerobot.processor", "lerobot.robots")  # what they export


def module_name(path: Path, source: Path) -> str:
    """Return the dotted name of a file, relative to the package: "control.fifo", and "control" for its __init__."""
    parts = path.relative_to(source).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imported_names(path: Path, source: Path) -> list[tuple[int, str]]:
    """Return the line and the absolute name of everything a file imports, wherever in the file it does so."""
    package, found = path.relative_to(source.parent).parent.parts, []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            found += [(node.lineno, f"{module}.{alias.name}") for alias in node.names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = ast.unparse(node.func)
            if function in ("__import__", "import_module", "importlib.import_module"):
                found.append((node.lineno, str(node.args[0].value)))
    return found


MODULES = {module_name(path, SOURCE) for path in SOURCE.rglob("*.py")}


def package_of(module: str) -> str:
    """Return the package in whose folder a file lies; of files beside the packages, their own name."""
    return module if module in ARROWS else module.rpartition(".")[0] or module


def module_of(name: str) -> str:
    """Return the module of a dotted name, which may name something in it."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name


def is_allowed(name: str, allowed: tuple[str, ...]) -> bool:
    """Tell whether what an import names may be imported."""
    module = module_of(name) or name
    for one in allowed:
        if one.endswith("*"):
            if f"{module}.".startswith(one[:-1]):
                return True
        elif one in (module, name, package_of(module)):
            return True
    return False


def is_for_plugins(name: str) -> bool:
    """Tell whether what an import names is what LeRobot makes for plug-ins."""
    packages = (name, name.rpartition(".")[0] if not name.rpartition(".")[2].islower() else "")
    return f"{name}.".startswith(tuple(f"{one}." for one in LEROBOT_MODULES)) or any(
        one in LEROBOT_PACKAGES for one in packages
    )


def wrong_imports(source: Path) -> list[str]:
    """Return one line of text for every import that breaks a rule in the package whose folder is `source`."""
    wrong = []
    for path in sorted(source.rglob("*.py")):
        importer = module_name(path, source)
        package = package_of(importer) if path.name != "__init__.py" else importer
        top_package = package.partition(".")[0]
        if package == "":
            allowed: tuple[str, ...] = ()
        elif package in ARROWS:
            stock = () if top_package in NEVER_IN["lerobot"] else ("stock",)
            allowed = (package, "errors", "options.declared", *stock, *ARROWS[package])
        elif path.name == "__init__.py" and not imported_names(path, source):
            continue
        else:
            wrong.append(f"{path.relative_to(source.parent)}: {package!r} is not in ARROWS")
            continue
        for line, name in imported_names(path, source):
            where = f"{path.relative_to(source.parent)}:{line}"
            top, _, rest = name.partition(".")
            if top == PACKAGE and not is_allowed(rest, allowed):
                wrong.append(f"{where}: {package or PACKAGE!r} may not import {name}")
            if top_package not in ONLY_IN.get(top, (top_package,)) or top_package in NEVER_IN.get(top, ()):
                wrong.append(f"{where}: {package!r} may not import {top}")
            elif top == "lerobot" and importer != "stock" and not is_for_plugins(name):
                wrong.append(f"{where}: only 'stock' may import {name}")
    return wrong


def test_every_import_follows_an_arrow() -> None:
    assert wrong_imports(SOURCE) == []


def test_what_is_for_any_robot_knows_no_body_of_ours() -> None:
    importers = {
        module_name(path, SOURCE)
        for path in SOURCE.rglob("*.py")
        for _, name in imported_names(path, SOURCE)
        if module_of(name.removeprefix(f"{PACKAGE}.")) in OWN_BODIES
    }
    assert {name for name in importers if not name.startswith("bodies.")} == OF_OWN_BODIES


@each_case(
    ("module", "statement"),
    [
        ("control/fifo.py", "from bhd_lerobot.sim.world import World"),
        ("control/fifo.py", "from bhd_lerobot import sim"),
        ("control/fifo.py", "from ..sim import world"),
        ("control/fifo.py", "from .. import sim"),
        ("control/fifo.py", "from bhd_lerobot.bodies.turtlebot3 import BURGER"),
        ("control/fifo.py", "def f():\n    import torch"),
        ("control/fifo.py", "import lerobot.robots"),
        ("control/fifo.py", "import mujoco"),
        ("control/fifo.py", "import bhd_lerobot"),
        ("tasks/avoid.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import mujoco"),
        ("policies/brain.py", "from bhd_lerobot.robots.turtlebot3 import TurtleBot3"),
        ("policies/brain.py", "import importlib\nimportlib.import_module('bhd_lerobot.datasets.writer.recorder')"),
        ("policies/mlp/modeling_mlp.py", "from ...robots import turtlebot3"),
        ("training/loop.py", "from lerobot.policies.factory import make_policy"),
        ("training/loop.py", "from lerobot.optim import factory"),
        ("sim/world.py", "from bhd_lerobot.stock import make_env"),
        ("errors.py", "from bhd_lerobot.bodies.body import Body"),
        ("cellar/wine.py", "x = 1"),
        ("__init__.py", "from bhd_lerobot.recording.record import main"),
    ],
)
def test_a_planted_wrong_import_is_found(tmp_path: Path, module: str, statement: str) -> None:
    path = tmp_path / PACKAGE / module
    path.parent.mkdir(parents=True)
    path.write_text(statement + "\n")
    assert len(wrong_imports(tmp_path / PACKAGE)) == 1


def test_the_arrows_form_no_cycle() -> None:
    def needs(package: str) -> set[str]:
        needed = set()
        for arrow in ARROWS[package]:
            below = {one for one in ARROWS if f"{one}.".startswith(arrow[:-1])} if arrow.endswith("*") else set()
            needed |= below or {package_of(arrow)}
        return needed & ARROWS.keys() - {package}

    free: set[str] = set()
    waiting = {package: needs(package) for package, arrows in ARROWS.items() if arrows != EVERYTHING}
    while waiting:
        ready = {package for package, needed in waiting.items() if needed <= free}
        assert ready, f"a cycle among {sorted(waiting)}"
        free |= ready
        waiting = {package: needed for package, needed in waiting.items() if package not in ready}


def test_a_folder_is_read_at_a_glance() -> None:
    folders = {path.parent for path in SOURCE.rglob("*.py")}
    long = {str(f.relative_to(SOURCE)): n for f in folders if (n := sum(1 for _ in f.glob("[!_]*.py"))) > MOST_FILES}
    assert long == {}


@each_case(
    ("changed", "tests", "laws", "no_laws"),
    [
        (
            "bhd_lerobot/control/arm/relief.py",
            "control/arm",
            {"control.arm", "robots", "cli"},
            {"control", "datasets.format"},
        ),
        ("bhd_lerobot/sim/world.py", "sim", {"sim", "robots.host", "envs"}, {"control", "datasets.format"}),
        ("tests/datasets/remote/test_hub.py", "datasets/remote/test_hub.py", set(), {"datasets.remote"}),
        ("constraints.txt", None, set(ARROWS), set()),
        ("README.md", None, set(), set(ARROWS)),
    ],
)
def test_a_change_concerns_the_tests_that_mirror_it_and_the_laws_of_what_may_import_it(changed, tests, laws, no_laws):
    mirrors, packages = selection.concerned({ROOT / changed})
    assert mirrors == ({ROOT / "tests" / tests} if tests else set())
    assert laws <= packages
    assert not no_laws & packages


def test_make_quick_runs_a_law_of_every_package_that_has_tests_of_its_own() -> None:
    files = list((ROOT / "tests").rglob("test_*.py"))
    states_law = [path for path in files if "pytest.mark.law" in path.read_text(encoding="utf-8")]
    tested, stated = ({selection.package_of(path.parent) for path in paths} for paths in (files, states_law))
    assert tested - stated == set()


def test_every_package_says_what_it_is_and_lists_its_modules() -> None:
    """Its `__init__.py` imports nothing: what is needed is imported where it is used."""
    for path in SOURCE.rglob("__init__.py"):
        if path.parent == SOURCE:
            continue
        documented, assigned = ast.parse(path.read_text(encoding="utf-8")).body
        assert isinstance(documented, ast.Expr), path
        parts = {p.stem for p in path.parent.glob("[!_]*.py")} | {
            p.parent.name for p in path.parent.glob("*/__init__.py")
        }
        assert ast.unparse(assigned) == f"__all__ = {sorted(parts)}", path


def test_the_plugin_module_is_one_import() -> None:
    tree = ast.parse((ROOT / "lerobot_robot_bhd.py").read_text(encoding="utf-8"))
    assert [ast.unparse(node) for node in tree.body] == ["import bhd_lerobot.plugin"]


# Written in two halves, or this file would break its own rule.
FORBIDDEN = [rf"(?<![\w.~-])/{folder}/\w" for folder in ("ho" + "me", "ro" + "ot", "wo" + "rk", "Us" + "ers")] + [
    re.escape(host) for host in ("pypi" + ".org", "pythonhosted" + ".org", "npmjs" + ".", "deb.debian" + ".org")
]


def tracked_files() -> list[Path]:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout, so nothing is tracked")
    listing = subprocess.run(
        ["git", "-c", f"safe.directory={ROOT}", "ls-files", "-z"],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if not k.startswith("GIT_")},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    names = [ROOT / name for name in listing.split("\0") if name]
    return [path for path in names if path.is_file() or path.is_symlink()]


def forbidden_lines(path: Path) -> list[str]:
    if path.is_symlink():
        target = path.readlink()
        return [f"{path}: a link to {target}"] * (target.is_absolute() or not path.exists())
    pattern = re.compile("|".join(FORBIDDEN))
    lines = path.read_bytes().decode("utf-8", errors="replace").splitlines()
    return [f"{path}:{number}: {line.strip()[:160]}" for number, line in enumerate(lines, 1) if pattern.search(line)]


def test_no_tracked_file_names_a_registry_or_a_folder_of_one_machine() -> None:
    files = tracked_files()
    assert files
    assert [line for path in files for line in forbidden_lines(path)] == []


@pytest.mark.parametrize("half", ["/ho|me/ann/x", "'/ro|ot/x", "see /wo|rk/main", "https://pypi|.org/simple"])
def test_a_planted_address_is_found(tmp_path: Path, half: str) -> None:
    path = tmp_path / "notes.md"
    path.write_text("fine: a/home/b, network/work/x, https://www.apache.org\n" + half.replace("|", "") + "\n")
    assert len(forbidden_lines(path)) == 1


def test_a_planted_link_to_another_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("fine")
    for name, target, found in (("good", "a", 0), ("absolute", tmp_path / "a", 1), ("nowhere", "b", 1)):
        (tmp_path / name).symlink_to(target)
        assert len(forbidden_lines(tmp_path / name)) == found
