"""The registry: a name stands for one thing, whoever adds it."""

import subprocess
import sys

import pytest

from bhd_lerobot.bodies.arenas import ARENAS, register_arena
from bhd_lerobot.envs.register import ENVIRONMENTS, register_environment
from bhd_lerobot.errors import ConfigError


def test_every_registry_refuses_another_thing_of_a_name() -> None:
    with pytest.raises(ConfigError, match="There is an arena 'empty' already"):
        register_arena("empty", ARENAS["random"])
    with pytest.raises(ConfigError, match="There is an environment 'UR5Pick-v0' already, of ur5 and pick"):
        register_environment("UR5Pick-v0", *ENVIRONMENTS["UR5Reach-v0"])


def test_what_is_named_by_its_place_is_imported_when_it_is_asked_for() -> None:
    program = (
        "import sys; from bhd_lerobot.options.registry import Registry;"
        "r = Registry('x', {'d': 'colorsys:hsv_to_rgb'});"
        "assert 'd' in r and 'colorsys' not in sys.modules; assert r['d'].__module__ == 'colorsys'"
    )
    subprocess.run([sys.executable, "-c", program], check=True, stdin=subprocess.DEVNULL)
