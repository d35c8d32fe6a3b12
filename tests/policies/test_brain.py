"""Brains find their inputs by name, or say at once what is missing."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.baselines import NoopBrain, NoopConfig
from bhd_lerobot.policies.blanked import BlankedConfig
from bhd_lerobot.policies.brain import Brain, find_columns, find_scan
from bhd_lerobot.policies.dagger.brain import DaggerConfig
from bhd_lerobot.policies.teleop.takeover import TakeoverBrain
from bhd_lerobot.recording.driver import open_driver
from bhd_lerobot.registry import make_brain
from bhd_lerobot.rollout.marks import Marks
from tests.cases import each_case
from tests.docs.support import ROOT


def scan_names(beams: int) -> tuple[str, ...]:
    return tuple(f"scan_{beam:03d}.pos" for beam in range(beams))


def test_columns_are_found_wherever_they_lie() -> None:
    names = ("c", "a", "b")
    assert find_columns(names, ("a", "b", "c"), "rule", "observation").tolist() == [1, 2, 0]
    assert find_columns(names, (), "rule", "observation").tolist() == []


def test_missing_columns_are_all_named() -> None:
    with pytest.raises(ConfigError, match=r"'rule' needs the action feature\(s\) y, z.*There is: a, b\."):
        find_columns(("a", "b"), ("y", "a", "z"), "rule", "action")


def test_a_long_list_of_features_is_cut_in_the_message() -> None:
    with pytest.raises(ConfigError, match=r"scan_007\.pos, …"):
        find_columns(scan_names(360), ("x.vel",), "rule", "observation")


@each_case("beams", [1, 3, 36, 90, 360])
def test_beams_go_once_around_counter_clockwise_from_straight_ahead(beams: int) -> None:
    columns, angles = find_scan(("x.vel", *scan_names(beams), "theta.vel"), "rule")
    assert (columns.start, columns.stop) == (1, 1 + beams)
    assert angles[0] == 0
    assert ((angles >= -np.pi) & (angles < np.pi)).all()
    assert_allclose(np.unwrap(angles), 2 * np.pi * np.arange(beams) / beams, atol=1e-12)


@each_case("names", [(), ("x.vel", "theta.vel"), ("scan_000.pos", "x.vel", "scan_001.pos"), ("scan_000.vel",)])
def test_no_scan_or_a_torn_one_is_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="'rule' needs a range scan"):
        find_scan(names, "rule")


def test_what_drives_a_recording_is_closed_with_all_that_it_is_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Any] = []

    def close(brain: NoopBrain) -> None:
        closed.append(brain)

    monkeypatch.setattr(NoopBrain, "close", close)
    one = NoopConfig()
    for config, parts in ((one, 1), (BlankedConfig(one, images=True), 1), (DaggerConfig(one, one), 2)):
        given: Any = SimpleNamespace(brain=config, teleop=None)
        with open_driver(given, Marks()):
            assert not closed
        assert len(set(map(id, closed))) == parts
        closed.clear()
    both: Any = TakeoverBrain(make_brain(one), NoopBrain(), lambda: False)  # type: ignore[arg-type]
    both.close()
    assert len(closed) == 2


def test_what_the_documents_say_that_a_brain_may_offer_it_may_offer() -> None:
    text = (ROOT / "docs" / "how_to" / "plugins.md").read_text(encoding="utf-8")
    table = text.partition("| attribute or method |")[2].partition("\n\n")[0]
    names = [name for line in table.splitlines() for name in re.findall(r"`(\w+)[`(]", line.partition(" | ")[0])]
    assert {"needs", "advice"} < set(names)
    assert [name for name in names if not hasattr(Brain, name)] == []
