"""`import bhd_lerobot`: light, complete, and what it does is what the commands do."""

import importlib
import inspect
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

import bhd_lerobot as bhd
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.conformance import ConformanceError
from tests.forks import Fork
from tests.waiting import until


def test_importing_it_imports_nothing_else() -> None:
    code = "import sys; before = set(sys.modules); import bhd_lerobot; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = {name.partition(".")[0] for name in done.stdout.split()}
    assert imported - set(sys.stdlib_module_names) <= {"bhd_lerobot"}
    assert [name for name in done.stdout.split() if name.startswith("bhd_lerobot.")] == []


def test_every_name_is_there_and_documented() -> None:
    assert 30 <= len(set(bhd.__all__) - {"__version__"}) <= 71
    assert dir(bhd) == sorted(bhd.__all__)
    for name in set(bhd.__all__) - {"__version__"}:
        assert getattr(bhd, name).__doc__, name


def test_functions_that_users_import_describe_every_argument() -> None:
    """The linter does not ask that of others; options are described where `--help` finds them."""
    for name in bhd.__all__:
        one = getattr(bhd, name)
        if not inspect.isfunction(one):
            continue
        given = inspect.signature(one).parameters.values()
        names = [given.name for given in given if given.kind not in (given.VAR_POSITIONAL, given.VAR_KEYWORD)]
        text = inspect.getdoc(one) or ""
        assert "Args:" not in text or set(names) <= set(re.findall(r"^ +(\w+):", text, re.MULTILINE)), name


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'recrod'"):
        _ = bhd.recrod
    assert importlib.import_module("bhd_lerobot.errors").BhdError is bhd.BhdError


@pytest.mark.parametrize(
    ("call", "options", "message"),
    [
        (bhd.record, {"brian": "noop"}, "brian.*brain"),
        (bhd.record, {"brain": "gap_folower", "task": "avoid", "robot": "turtlebot3"}, "gap_folower.*gap_follower"),
        (bhd.evaluate, {"n_episode": 3}, "n_episode.*n_episodes"),
        (bhd.train, {"stepz": 3, "dataset": {"repo_id": "a/b"}}, "stepz.*steps"),
        (bhd.replay, {"dataset": {"rot": "x"}}, "rot.*root"),
    ],
)
def test_misspelt_keywords_name_the_near_miss(call, options, message) -> None:
    with pytest.raises(bhd.BhdError, match=message):
        call(**options)


def interrupted_as_in_a_notebook(folder: Path) -> None:
    """Record in the main thread, get a SIGINT as Jupyter's stop button sends it, and go on."""
    options: dict[str, Any] = {
        "robot": {"type": "turtlebot3", "beams": 36}, "brain": "gap_follower", "task": "avoid", "seed": 3,
        "dataset": {"root": folder / "d", "num_episodes": 3, "episode_time_s": 30}, "preview_video": False,
    }  # fmt: skip
    before = signal.getsignal(signal.SIGINT)

    def interrupt() -> None:
        until(lambda: (folder / "d" / "meta" / "episodes").exists() or list((folder / "d").rglob("*.parquet")))
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    result = bhd.record(**options, output_dir=folder / "first")
    assert result.stopped_by is not None
    assert result.stopped_by.name == "SIGINT"
    assert result.recorded < 3
    assert signal.getsignal(signal.SIGINT) is before
    again = bhd.record(**options, output_dir=folder / "second", resume=True)
    assert again.recorded == 3 - result.recorded
    assert bhd.check_dataset(folder / "d").is_valid


def test_a_notebook_may_interrupt_a_recording_and_go_on(tmp_path) -> None:
    fork = Fork(interrupted_as_in_a_notebook, tmp_path, output=tmp_path / "out")
    assert fork.wait() == 0, (tmp_path / "out").read_text()


def test_a_robot_is_made_of_its_type_or_a_dictionary_also_one_of_lerobot(monkeypatch) -> None:
    monkeypatch.setattr("bhd_lerobot.api.make_robot_from_config", lambda config: config)
    for robot in ("so101_follower", {"type": "so101_follower"}):
        assert bhd.make_robot(robot, port="/dev/ttyACM0").port == "/dev/ttyACM0"
    assert bhd.make_brain({"type": "gap_follower", "margin_m": 0.1}).config.margin_m == 0.1
    with pytest.raises(bhd.BhdError, match="Did you mean 'so101_follower'"):
        bhd.make_robot("so101_folower")
    with pytest.raises(bhd.BhdError, match=r"Did you mean 'robot\.beams'"):
        bhd.make_robot("turtlebot3", beens=36)


class Forgetful(bhd.SimulatedBase):
    """A plug-in's robot whose author forgot what `send_action` has to return."""

    config_class = TurtleBot3Config
    name = "forgetful"

    def send_action(self, action: Any) -> Any:
        super().send_action(action)


def test_a_robot_that_breaks_the_contract_is_told_how() -> None:
    with pytest.raises(ConformanceError, match="send_action") as caught:
        bhd.check_robot(lambda: Forgetful(TurtleBot3Config()))
    assert "NoneType" in str(caught.value) or "None" in str(caught.value)


def test_the_python_of_the_readme_runs(tmp_path, monkeypatch) -> None:
    text = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
    first, second, *_ = re.findall(r"```python\n(.*?)```", text.partition("## From Python")[2], re.DOTALL)
    assert len(first.strip().splitlines()) <= 20
    shorter = first
    for long, short in (
        ("steps=1000", "steps=20"),
        ("n_episodes=16", "n_episodes=2"),
        ('"num_episodes": 16}', '"num_episodes": 2, "episode_time_s": 3}'),
        ('task="avoid", brains', 'task={"type": "avoid", "duration_s": 2}, brains'),
    ):
        assert long in shorter
        shorter = shorter.replace(long, short)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(shorter, names)
    exec(second, names)
    assert [row["step"] for row in names["trained"].rows] == [10, 20]
    assert all(one.identical for one in bhd.replay(dataset={"root": "data/python", "episode": 1}))
