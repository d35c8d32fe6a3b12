"""What a brain that sees does where it is asked for what is not there.

`python -m benchmarks.refusals --path=CHECKPOINT`. On each of many tables, which no recording has shown, the brain
`language` with this perception is asked once for an object that stands there, once for a name that nothing there has,
and once for "the cup" or "the box" where there are several. It is to go for the first, and to refuse the others. Each
question is about a table of its own, so the intervals are Wilson's. Evaluations ask for what is there only, and would
not show a brain that takes anything.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks._report import parse_options, rate, write
from bhd_lerobot.bodies.tabletop import COLOURS, KINDS, TableScene
from bhd_lerobot.control.commands import Goals
from bhd_lerobot.envs.stage import Stage
from bhd_lerobot.errors import BhdError
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.language.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.perception.assessment import assess
from bhd_lerobot.policies.perception.perceiver import PerceptionOptions
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.task import episode_seed
from bhd_lerobot.tasks.variation import RandomisationConfig

QUESTIONS = ("there", "absent", "several")
SENTENCE = "pick up the {}"


def questions(scene: TableScene, rng: np.random.Generator) -> dict[str, str]:
    """Return what is asked for on a table, by the kind of the question."""
    names = [one.name for one in scene.objects]
    target = scene.objects[scene.target_object or 0].name
    absent = sorted({f"{colour} {kind}" for colour in COLOURS for kind in KINDS}.difference(names))
    several = [kind for kind in KINDS if sum(one.kind == kind for one in scene.objects) > 1]
    asked = {"there": target} if names.count(target) == 1 else {}
    asked["absent"] = str(rng.choice(absent))
    return asked | ({"several": str(rng.choice(several))} if several else {})


def ask(perception: PerceptionOptions, world: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return how often the brain went for an object, and how often for the right one, by kind of question.

    Args:
        perception: how the brain sees.
        world: `nominal`, `randomised`, or `unseen`: randomised, with objects of a style that was not learned from.
        seeds: of the tables.
    """
    brain = LanguageBrain(LanguageBrainConfig(perception=perception))
    assert brain.perceiver is not None
    width, height = brain.perceiver.image_size
    robot = UR5Config(camera=True, camera_width=width, camera_height=height)
    objects = "unseen" if world == "unseen" else "known"
    task = PickConfig(randomisation=RandomisationConfig(enabled=world != "nominal"), objects=objects)
    stage, one = Stage(robot, task, threads=1), np.array([0])
    simulation = stage.simulation
    brain.bind(RobotFeatures(simulation.observation_names, simulation.action_names, robot.fps, ()))
    counts = {kind: {"tables": 0, "went": 0, "right": 0} for kind in QUESTIONS}
    for number in seeds:
        stage.reset(one, [number])
        seen, scene = stage.observe(), stage.scenes[0]
        for kind, name in questions(scene, np.random.default_rng(number)).items():
            brain.reset(one, [number], 1, [SENTENCE.format(name)])
            command = brain.act(Observation(simulation.observation_names, seen.state.astype(float), seen.images))
            went = isinstance(command, Goals) and bool(command.commands.get(0))
            count = counts[kind]
            count["tables"] += 1
            count["went"] += went
            count["right"] += went and kind == "there" and assess(brain.plan(0), scene)["wrong"] == 0
    stage.close()
    return counts


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask in each world, and print how often the brain went for something; return the exit status."""
    options = parse_options(
        __doc__,
        arguments,
        path={"required": True, "help": "checkpoint of a bhd_perception"},
        worlds={"nargs": "+", "choices": ("nominal", "randomised", "unseen"), "default": ["nominal"]},
        episodes=(500, "tables"),
        seed=0,
        split={"choices": ("held_out", "validation"), "default": "held_out"},
        min_certainty={"type": float, "help": "as brain.perception.min_certainty; its default if left out"},
    )
    certainty = {} if options.min_certainty is None else {"min_certainty": options.min_certainty}
    seeds = [episode_seed(options.seed, episode, options.split) for episode in range(options.episodes)]
    found = {}
    for world in options.worlds:
        try:
            found[world] = ask(PerceptionOptions(options.path, **certainty), world, seeds)
        except BhdError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        for kind, count in found[world].items():
            if not count["tables"]:
                continue
            key = "right" if kind == "there" else "went"
            found_rate = rate(asdict(wilson(count[key], count["tables"])), {})
            words = "went for it" if kind == "there" else "went for something"
            print(f"{world}, asked for what is {kind}: {words} {found_rate} of {count['tables']}")
    write(options.json, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
