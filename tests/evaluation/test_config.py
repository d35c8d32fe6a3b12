"""What `bhd-eval` takes and refuses, and what is in the configurations that we ship."""

from pathlib import Path

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from tests.cases import each_case

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / "eval").glob("*.yaml"))
BASE = ["--robot.type=turtlebot3", "--task.type=avoid"]
TWO = [*BASE, "--brains.old.type=avoidance", "--brains.new.type=gap_follower"]


def test_a_command_line_adds_takes_out_and_chooses_brains(tmp_path):
    path = tmp_path / "eval.yaml"
    path.write_text(
        "robot: {type: turtlebot3}\ntask: {type: avoid}\nbrains:\n  a: {type: avoidance}\n  b: {type: avoidance}\n"
    )
    at = f"--config_path={path}"
    assert list(parse(EvalConfig, [at, "--brains.c.type=gap_follower"]).brains) == ["a", "b", "c"]
    assert list(parse(EvalConfig, [at, "--brains.a=null"]).brains) == ["b"]
    assert parse(EvalConfig, [at, "--brains.c=gap_follower"]) == parse(EvalConfig, [at, "--brains.c.type=gap_follower"])
    chosen = parse(EvalConfig, [at, "--baseline=a", "--only=[b]"])
    assert list(chosen.chosen) == ["b"]
    assert chosen.reference == "b"


def test_one_brain_has_a_short_form():
    config = parse(EvalConfig, [*BASE, "--brain.type=gap_follower", "--brain.margin_m=0.1"])
    assert list(config.brains) == ["gap_follower"]
    assert config.brains["gap_follower"].margin_m == 0.1
    assert config.brain is None


@pytest.mark.law
@each_case(
    ("arguments", "message"),
    [
        (BASE, "no brain to evaluate"),
        ([*BASE, "--brains.a.type=avoidance", "--brains.a.speed=1"], "brains.a.speed"),
        ([*BASE, "--brains.a.forward_speed=1"], "brains.a.type is missing"),
        ([*BASE, "--brains=avoidance"], "such as brains.NAME.type"),
        ([*BASE, "--brains.my-brain.type=avoidance"], "'my-brain' is not a valid name"),
        ([*BASE, "--brains.a.type=reach"], "brains.a.type is 'reach', which needs an arm; robot.type is 'turtlebot3'"),
        (
            ["--robot.type=ur5", "--task.type=avoid", "--brains.a.type=avoidance"],
            "which needs a drive; robot.type is 'ur5', which has none. Valid: turtlebot3",
        ),
        ([*TWO, "--baseline=older"], "Did you mean 'old'"),
        ([*TWO, "--only=[never]"], "Unknown brain in only 'never'"),
        ([*TWO, "--only=[]"], "only is empty"),
        ([*TWO, "--episodes=[]"], "at least one episode"),
        ([*TWO, "--episodes=[1,1]"], "none twice"),
        ([*TWO, "--record.root=somewhere"], "record.repo_id is not"),
        ([*BASE, "--brain.type=avoidance", "--plan=true"], "'avoidance' is the only brain: nothing is compared."),
        ([*TWO, "--only=[old]", "--sequential=true"], "'old' is the only brain: nothing is compared. Add one"),
        ([*TWO, "--only=[old]", "--baseline=new", "--sequential=true"], "baseline is 'new', which only leaves out."),
        ([*TWO, "--plan=true", "--baseline=never"], "Unknown brain in baseline 'never'"),
        ([*TWO, "--sequential=true", "--engine=ray"], "Use --engine=local"),
        ([*TWO, "--fps=20"], "set --robot.fps instead"),
        ([*TWO[:1], "--task.type=free", "--task.instruction=go", *TWO[2:]], "Add --robot.clock=realtime"),
        ([*TWO, "--brain.type=avoidance", "--brains.avoidance.type=avoidance"], "two brains of the name 'avoidance'"),
    ],
)
def test_what_cannot_be_honoured_is_refused_by_name(arguments, message):
    with pytest.raises(ConfigError) as caught:
        parse(EvalConfig, arguments)
    assert message in str(caught.value)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configurations_are_valid_and_compare_held_out_seeds(path):
    config = parse(EvalConfig, [f"--config_path={path}"])
    assert len(config.brains) > 1 or path.stem == "ur5_look", "perception is measured by itself"
    assert config.split == "held_out"
    assert config.reference in config.brains
