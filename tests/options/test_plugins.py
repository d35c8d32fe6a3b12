"""Plug-ins that are wrong: each is named, and the rest goes on."""

import importlib
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

import bhd_lerobot as bhd
from bhd_lerobot import registry
from bhd_lerobot.bodies import registry as bodies
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options import plugins
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.tasks.task import TaskConfig
from tests.cases import each_case
from tests.recording.support import options

BRAIN = """
from dataclasses import dataclass
import bhd_lerobot as bhd

@dataclass
class Config(bhd.BrainConfig):
    pass

@bhd.register_brain("{name}", Config)
class Mine(bhd.Brain):
    needs = (bhd.Drive,)
"""


class Installer:
    """A folder of distributions, each with a module of its name."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        patch.syspath_prepend(folder)
        patch.setattr(plugins, "_imported", set())

    def install(self, name: str, text: str) -> None:
        """Install a distribution."""
        (self.folder / f"{name}.py").write_text(textwrap.dedent(text), encoding="utf-8")
        about = self.folder / f"{name}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
        importlib.invalidate_caches()


@pytest.fixture
def installer(tmp_path, monkeypatch):
    """Return where a test installs plug-ins; afterwards nothing of them is known."""
    choices = [(kind, dict(kind._choice_registry)) for kind in (BrainConfig, TaskConfig)]
    modules = set(sys.modules)
    monkeypatch.setattr(registry.BRAINS, "_table", dict(registry.BRAINS._table))
    yield Installer(tmp_path, monkeypatch)
    for kind, known in choices:
        kind._choice_registry.clear()
        kind._choice_registry.update(known)
    for name in set(sys.modules) - modules:
        if name.startswith("lerobot_"):
            del sys.modules[name]


def test_one_that_raises_is_named_and_the_others_are_there(installer) -> None:
    installer.install("lerobot_policy_broken", "import no_such_module")
    installer.install("lerobot_robot_good", BRAIN.format(name="good"))
    reported: list[str] = []
    plugins.load_plugins(reported.append)
    [text] = reported
    assert "lerobot_policy_broken" in text
    assert "ModuleNotFoundError: No module named 'no_such_module'" in text
    assert "good" in registry.brains_for("turtlebot3")
    plugins.load_plugins(reported.append)
    assert len(reported) == 1  # once


def test_it_is_reported_on_the_standard_error_of_a_command(installer, capsys) -> None:
    installer.install("lerobot_robot_broken", "raise RuntimeError('not\\ntoday')")
    plugins.load_plugins()
    assert "warning: The plug-in lerobot_robot_broken cannot be imported" in capsys.readouterr().err


def test_a_name_that_is_taken_is_refused_and_the_first_stays(installer) -> None:
    installer.install("lerobot_robot_first", BRAIN.format(name="twice"))
    installer.install("lerobot_robot_second", BRAIN.format(name="twice"))
    reported: list[str] = []
    plugins.load_plugins(reported.append)
    [text] = reported
    assert "lerobot_robot_second" in text
    assert "There is a brain 'twice' already, of lerobot_robot_first; that of lerobot_robot_second needs" in text
    assert BrainConfig.get_choice_class("twice").__module__ == "lerobot_robot_first"


def test_what_is_not_derived_from_the_base_class_is_refused(installer) -> None:
    installer.install("lerobot_robot_plain", BRAIN.format(name="plain").replace("Mine(bhd.Brain)", "Mine"))
    reported: list[str] = []
    plugins.load_plugins(reported.append)
    [text] = reported
    assert "brain 'plain', Mine, is not derived from bhd_lerobot.Brain" in text
    assert "write class Mine(bhd.Brain)" in text
    assert "plain" not in registry.brains_for("turtlebot3")
    with pytest.raises(ConfigError, match=r"task 'mine', Mine, is not derived.* write class Mine\(bhd\.Task\)"):
        registry.register_task("mine", bhd.TaskConfig)(type("Mine", (), {}))


@each_case(
    ("attribute", "value"), [("robot_kind", "base"), ("needs", bhd.Drive), ("needs", ("base",)), ("needs", None)]
)
@each_case(("register", "base"), [(registry.register_brain, bhd.Brain), (registry.register_task, bhd.Task)])
def test_needs_are_parts_of_a_robot_and_an_old_robot_kind_is_named(
    register: Any, base: type, attribute: str, value: Any
) -> None:
    made = type("Mine", (base,), {attribute: value})
    given = re.escape(f"{attribute} = {value!r}")
    with pytest.raises(ConfigError, match=rf"class of 'mine', Mine, has {given}\. .*needs = \(bhd\.Drive"):
        register("mine", bhd.BrainConfig)(made)


def test_a_configuration_without_its_class_is_refused(installer, tmp_path) -> None:
    installer.install(
        "lerobot_robot_half",
        """
        from dataclasses import dataclass
        import bhd_lerobot as bhd

        @bhd.BrainConfig.register_subclass("half")
        @dataclass
        class Config(bhd.BrainConfig):
            pass
        """,
    )
    plugins.load_plugins()
    with pytest.raises(ConfigError, match=r"'half' has a configuration, lerobot_robot_half\.Config, and no class"):
        parse(RecordConfig, options(tmp_path / "d", brain__type="half"))


def test_a_module_that_an_option_names_is_imported_or_refused(installer, tmp_path, monkeypatch) -> None:
    (installer.folder / "my_brains.py").write_text(BRAIN.format(name="named"), encoding="utf-8")
    importlib.invalidate_caches()
    left = plugins.load_named(["--n=1", "--robot.discover_packages_path=my_brains", "--brain.type=named"])
    assert left == ["--n=1", "--brain.type=named"]
    assert "named" in registry.brains_for("turtlebot3")
    with pytest.raises(ConfigError, match=r"--brain\.discover_packages_path names 'no_brains', which cannot be"):
        plugins.load_named(["--brain.discover_packages_path", "no_brains"])
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder])  # as of an installed command
    Path("in_this_folder.py").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"write PYTHONPATH=\. before the command"):
        plugins.load_named(["--task.discover_packages_path=in_this_folder"])


def test_a_robot_that_no_plug_in_has_is_looked_for_once(installer, monkeypatch) -> None:
    """To list what is installed takes some hundredths of a second, and datasets are asked for each episode."""
    looked = []
    installed = plugins._installed
    monkeypatch.setattr(plugins, "_installed", lambda: looked.append(1) or installed())
    monkeypatch.setattr(bodies, "_unknown", set())
    monkeypatch.setattr(bodies.BODIES, "_table", dict(bodies.BODIES._table))
    assert [bodies.body_of("toy") for _ in range(5)] == [None] * 5
    assert len(looked) == 1
    bodies.BODIES.register("toy", bodies.BODIES["ur5"])
    assert bodies.body_of("toy") is not None
