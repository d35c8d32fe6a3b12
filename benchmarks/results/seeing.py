"""The section about seeing: an instruction carried out with nothing but the scene camera, from three training seeds."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from benchmarks.results.learning import aggregation, record, seeds_row, success_row, train
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, rate
from bhd_lerobot.errors import counted

EPISODES, SEEDS = 500, (0, 1, 2)
_ANY = "--task.language=any"
_VARIED = "--task.randomisation.enabled=true"
# Name, options of the task, and the success that is to be reached with 95 % confidence.
WORLDS: tuple[tuple[str, tuple[str, ...], float | None], ...] = (
    ("the world as it is", (_ANY,), 0.9),
    ("randomised light, colours, sizes, camera", (_ANY, _VARIED), 0.8),
    ("objects that it has not seen", (_ANY, _VARIED, "--task.objects=unseen"), 0.7),
    ("other sentences", (_ANY, "--task.wording=held_out"), None),
    ("pairs of colour and kind", (_ANY, "--task.names=held_out"), None),
    ("the same scenes, two or more objects", (_ANY, "--task.min_objects=2"), None),
    ("the same scenes, another object is asked for", (_ANY, "--task.min_objects=2", "--task.swap=true"), 0.95),
)
_PIXELS_GOAL, _ROUNDS = 0.6, 2
_FEW = ("--steps=300", "--eval_steps=300")
_OTHERS = ("act", "diffusion")
_BLANKED = 100  # episodes of the brains that are deaf or blind: none of them succeeds


def see(run: Runner, section: Section) -> None:
    """Learn to see tables, and pick what an instruction names from what is seen."""
    record_tables(run)
    seeds = run.seeds(SEEDS)
    for seed in seeds:
        train_perception(run, seed)
    looks = _evaluate(run, "see_look", "ur5_look", _seeing(run), ())
    for name in _names(run):
        _perceived(section, name, looks["brains"][name]["perception"])
    for number, (what, options, goal) in _worlds(run):
        results = _evaluate(run, f"see_{number}", "ur5_pick", _seeing(run), options)
        for name in _names(run):
            row, low = success_row(results, name), results["brains"][name]["success"]["low"]
            words = "" if goal is None else f"lower end at least {goal:.0%}"
            section.rows.append(Row(f"{what}: {row.what}", row.value, words, None if goal is None else low >= goal))
        section.rows.append(seeds_row(results, _names(run), what))
    blanked = []
    for name, sense in (("deaf", "instruction"), ("blind", "images")):
        inner = (f"--brains.{name}.brain.type=language", f"--brains.{name}.brain.perception.path={_path(run, 0)}")
        blanked += [f"--brains.{name}.type=blanked", f"--brains.{name}.{sense}=true", *inner]
    results = _evaluate(run, "see_blanked", "ur5_pick", blanked, (_ANY,), names=("deaf", "blind"), episodes=_BLANKED)
    section.rows += [success_row(results, name) for name in ("deaf", "blind")]
    section.rows.append(
        Row("time from nothing to the first seed", f"{sum(one.seconds for one in run.commands[:2]):.0f} s")
    )
    section.remarks.append(
        f"{counted(len(seeds), 'seed')} of the training. The brain `language` sees with the checkpoint and gets "
        "nothing else of the objects; the skill `pick` does the rest. A deaf brain gets an empty instruction, a blind "
        "one black images: both refuse, and say why. What was learned from has no object of the style of those that "
        "it has not seen, and none of their sizes and shades (`bhd_lerobot/tasks/pick.py`)."
    )


def record_tables(run: Runner) -> None:
    """Record the tables that are learned to be seen."""
    record(run, "see_record", "ur5_look", "see/tables", episodes=run.size(12_000, 800), options=("--seed=11",))


def train_perception(run: Runner, seed: int) -> str:
    """Train a perception on them; return its folder."""
    options = (f"--seed={seed}",)
    train(run, f"see_train_{seed}", "perception_ur5", _folder(seed), "see/tables", options=options, short=_FEW)
    return _folder(seed)


def pixels(run: Runner, section: Section) -> None:
    """Learn to pick what an instruction names from images, end to end."""
    size = ("--robot.camera_width=160", "--robot.camera_height=120")
    record(
        run, "pixels_tables", "ur5_look", "pixels/tables", episodes=run.size(12_000, 800), options=("--seed=11", *size)
    )
    # Of these only the first frame: what is meant is learned from many tables, and picking from fewer.
    firsts, options = "pixels/firsts", ("--seed=500", "--task.duration_s=0.1")
    record(run, "pixels_firsts", "ur5_pick_pixels", firsts, episodes=run.size(6_000, 400), options=options)
    last, folders = run.size(_ROUNDS, 1), {}
    for seed in run.seeds(SEEDS):
        eyes, folder = f"pixels/perception_{seed}", f"pixels/seed_{seed}"
        options = (f"--seed={seed}", "--steps=6000")
        train(run, f"pixels_see_{seed}", "perception_ur5", eyes, "pixels/tables", options=options, short=_FEW)
        name, config, learn = f"pixels_train_{seed}", "dagger_ur5_pixels", [f"--policy.perception={run.path(eyes)}"]
        folders[f"seed_{seed}"], _ = aggregation(
            run,
            name,
            config,
            folder,
            seed=seed,
            rounds=_ROUNDS,
            short=(60, 30, 8),
            steps=800,
            policy=learn,
            data=[str(run.path(firsts))],
        )
    seconds = sum(one.seconds for one in run.commands[:4])
    brains = [
        option
        for name, folder in folders.items()
        for option in (f"--brains.{name}.type=learned", f"--brains.{name}.path={run.path(folder)}")
    ]
    for number, (what, options, _) in _worlds(run):
        results = _evaluate(run, f"pixels_{number}", "ur5_pick_pixels", brains, options)
        goal = _PIXELS_GOAL if number == 0 else None
        for name in _names(run):
            row, low = success_row(results, name), results["brains"][name]["success"]["low"]
            words = "" if goal is None else f"lower end at least {goal:.0%}"
            section.rows.append(Row(f"{what}: {row.what}", row.value, words, None if goal is None else low >= goal))
        section.rows.append(seeds_row(results, _names(run), what))
    others, picks = [], f"pixels/seed_{SEEDS[0]}/round_0/data"
    for name in _OTHERS:
        folder = f"pixels/{name}"
        train(run, f"pixels_{name}", f"{name}_ur5_pixels", folder, picks, short=("--steps=4", "--batch_size=8"))
        others += [f"--brains.{name}.type=learned", f"--brains.{name}.path={run.path(folder)}"]
    results = _evaluate(run, "pixels_others", "ur5_pick_pixels", others, (_ANY,), names=_OTHERS, episodes=_BLANKED)
    section.rows += [
        replace(row, what=f"{WORLDS[0][0]}, deaf by construction: {row.what}")
        for row in (success_row(results, name) for name in _OTHERS)
    ]
    blanked = []
    for name, sense in (("deaf", "instruction"), ("blind", "images")):
        inner = (f"--brains.{name}.brain.type=learned", f"--brains.{name}.brain.path={run.path(folders['seed_0'])}")
        blanked += [f"--brains.{name}.type=blanked", f"--brains.{name}.{sense}=true", *inner]
    options = (_ANY,)
    results = _evaluate(
        run, "pixels_blanked", "ur5_pick_pixels", blanked, options, names=("deaf", "blind"), episodes=_BLANKED
    )
    section.rows += [success_row(results, name) for name in ("deaf", "blind")]
    section.rows.append(Row("time from nothing to the first seed", f"{seconds:.0f} s"))
    section.remarks.append(
        f"`bhd_pixels` after {counted(last, 'round')} of aggregation, {counted(len(folders), 'seed')} of recordings "
        "and trainings: from an episode's first image of 160 x 120 pixels, the instruction as bytes and the robot's "
        "state to tool poses. True poses taught it where to look; none is an input. A deaf policy gets an empty "
        "instruction, a blind one black images. LeRobot's ACT and Diffusion, with a ResNet18 that begins from "
        "nothing, learn from every frame of the rule's episodes; they have no input for words, and can do no better "
        "than to pick any one of the objects."
    )


def _perceived(section: Section, name: str, saw: Any) -> None:
    median, most, _ = (1000 * (math.nan if value is None else value) for value in saw["error_m"])
    what = f"{name}: in {saw['episodes']} tables, randomised"
    section.rows += [
        Row(f"{what}: error of what was asked for", f"median {median:.1f} mm, 90 % below {most:.1f} mm"),
        Row(f"{what}: wrong object", rate(saw["wrong"], {})),
        Row(f"{what}: within the radius stated for 90 %", rate(saw["in_90"], {})),
    ]


def _evaluate(
    run: Runner,
    name: str,
    config: str,
    brains: Sequence[str],
    options: Sequence[str],
    *,
    names: Sequence[str] = (),
    episodes: int = EPISODES,
) -> Any:
    only = ",".join(names or _names(run))
    command = ["bhd-eval", f"--config_path=configs/eval/{config}.yaml", "--robot.camera=true", *brains, *options]
    command += [f"--only=[{only}]", f"--n_episodes={run.size(episodes, 12)}", "--videos=0"]
    run.run(name, [*command, f"--output_dir={run.path(name)}"], makes=(name,))
    return run.read(name, "results.json")


def _worlds(run: Runner) -> Sequence[tuple[int, tuple[str, tuple[str, ...], float | None]]]:
    """Return the worlds with their numbers; of a short run the first, and the one in which words decide."""
    worlds = list(enumerate(WORLDS))
    return [worlds[0], worlds[-1]] if run.is_short else worlds


def _names(run: Runner) -> list[str]:
    return [f"seed_{seed}" for seed in run.seeds(SEEDS)]


def _seeing(run: Runner) -> list[str]:
    return [
        option
        for seed, name in zip(run.seeds(SEEDS), _names(run), strict=True)
        for option in (f"--brains.{name}.type=language", f"--brains.{name}.perception.path={_path(run, seed)}")
    ]


def _path(run: Runner, seed: int) -> str:
    return str(run.path(_folder(seed)))


def _folder(seed: int) -> str:
    return f"see/seed_{seed}"
