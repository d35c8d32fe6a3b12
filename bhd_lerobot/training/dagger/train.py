"""`bhd-train` with `algorithm: dagger`: a policy drives, an expert corrects it, and it learns from that, in rounds."""

import contextlib
import json
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.table import Table

from bhd_lerobot.datasets.edit.edits import merge
from bhd_lerobot.datasets.format.features import EXPERT_ACTION
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import evaluate
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.options.parse import RUN_CONFIG, encode, read_file
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.training import train as training
from bhd_lerobot.training.checkpoint import last_checkpoint
from bhd_lerobot.training.dagger.config import (
    FILES,
    OWN,
    STAGES,
    AggregationConfig,
    Stages,
    command,
    kept,
    parse_aggregation,
    read_stages,
)
from bhd_lerobot.training.plots import draw_rounds

ROUNDS, CURVE = "rounds.json", "rounds.png"
_DONE = "done.json"
_SIGNALLED = 128  # what an exit status is above if a signal stopped the program
_PROGRAMS: dict[str, Callable[[Sequence[str]], int]] = {
    "bhd-record": partial(run, Program(RecordConfig, lambda config: record(config).exit_status)),
    "bhd-train": partial(run, training.PROGRAM),
    "bhd-eval": partial(run, Program(EvalConfig, lambda config: evaluate(config).exit_status)),
}


class _StoppedError(Exception):
    """A program ended otherwise than well."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


def train(config: AggregationConfig, console: Console | None = None) -> int:
    """Do the rounds that are not done yet; return the exit status."""
    stages = read_stages(config)
    _check_data(config, stages)
    folder = Path(config.output_dir).expanduser()
    _keep_to(folder, config)
    rounds = _Rounds(config, stages, folder, console or Console(stderr=True))
    try:
        for number in range(config.rounds + 1):
            rounds.go(number)
    except _StoppedError as stopped:
        return stopped.status
    rounds.conclude()
    return 0


def _check_data(config: AggregationConfig, stages: Stages) -> None:
    """Check datasets that were recorded before, so that nothing is recorded in vain; merging checks their features."""
    for root in config.data:
        found = dataset_info(Path(root).expanduser())
        if (found.robot_type, found.fps) != (stages.robot, stages.fps):
            raise ConfigError(
                f"data names {root}, in which a {found.robot_type} was recorded with {found.fps} frames a second; the "
                f"expert of {config.expert.config!r} drives a {stages.robot} with {stages.fps}. Name datasets of that "
                "robot and frame rate."
            )
        if stages.has_advice and EXPERT_ACTION not in found.features:
            raise ConfigError(
                f"data names {root}, which has no {EXPERT_ACTION} to train on. Record it with "
                "--dataset.expert_action=true, or leave it out."
            )


def _keep_to(folder: Path, config: AggregationConfig) -> None:
    """Note the configuration in the folder, and what the files in it say.

    Refuse one that differs in more than how many rounds there are. Of a file its content counts, and of a dataset which
    folder it is, not by which path it is named.
    """
    before = kept(folder)
    if before is None and folder.exists() and any(folder.iterdir()):
        raise ConfigError(f"The folder {folder} holds other files. Set another --output_dir.")
    files = {stage.config: read_file(Path(stage.config).expanduser()) for stage in config.stages}
    if before is not None:
        known = read_file(folder / FILES) if (folder / FILES).exists() else {}
        then, now = _plain(before), _plain(config)
        for old, new in ((then[name], now[name]) for name in STAGES):
            new["config"] = files[new["config"]]
            old["config"] = known.get(old["config"], new["config"])
        if differing := _differing(then, now):
            raise ConfigError(
                f"The rounds in {folder} were made with something else: {', '.join(differing)}. Undo that, or set "
                "another --output_dir."
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, what in ((RUN_CONFIG, encode(config)), (FILES, files)):
            Disk().publish(folder / name, yaml.safe_dump(what, sort_keys=False, allow_unicode=True).encode())
    except OSError as error:
        raise BhdError(f"The folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error


def _plain(config: AggregationConfig) -> dict[str, Any]:
    """Return what makes the rounds, as plain values."""
    values = {name: value for name, value in encode(config).items() if name not in ("rounds", "output_dir")}
    return values | {"data": [str(Path(root).expanduser().resolve()) for root in config.data]}


def _differing(before: Any, now: Any, name: str = "") -> list[str]:
    """Return what differs between two configurations and is not set by the rounds, each with both values."""
    if name.partition(".config.")[2] in OWN:
        return []
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return [] if before == now else [f"{name} was {before}, and is {now}"]
    keys = dict.fromkeys([*before, *now])
    pairs = ((f"{name}.{key}" if name else str(key), before.get(key), now.get(key)) for key in keys)
    return [one for key, old, new in pairs for one in _differing(old, new, key)]


class _Rounds:
    def __init__(self, config: AggregationConfig, stages: Stages, folder: Path, console: Console) -> None:
        self._config, self._stages, self._folder, self._console = config, stages, folder, console
        self._rows = _reported(folder)
        self._expert: dict[str, Any] = {}
        self._seconds = 0.0

    def go(self, number: int) -> None:
        """Do what is not done yet of a round."""
        folder = self._folder / f"round_{number}"
        note = _note(folder)
        for name, step in (("record", self._record), ("train", self._train), ("evaluate", self._evaluate)):
            if name in note["done"]:
                continue
            started = time.perf_counter()
            try:
                step(number, folder)
                note["done"].append(name)
            finally:  # what took time counts, even if it was stopped and is done again
                note["seconds"] += time.perf_counter() - started
                with contextlib.suppress(OSError):  # a step that is not noted is done again
                    Disk().publish(folder / _DONE, json.dumps(note).encode())
        self._seconds += note["seconds"]
        self._rows = dict(sorted({**self._rows, number: self._row(number, folder)}.items()))
        rows = list(self._rows.values())
        report = {"expert": {"type": self._stages.expert, **self._expert}, "rounds": rows}
        Disk().publish(self._folder / ROUNDS, (json.dumps(report, indent=2) + "\n").encode())
        draw_rounds(rows, self._expert, self._folder / CURVE, self._folder.resolve().name)

    def conclude(self) -> None:
        """Show the rounds, and how to judge the last policy."""
        table = Table(title=None, box=None, pad_edge=False)
        for column in ("round", "episodes", "expert drove", "success, 95 %", "score, 95 %", "time so far"):
            table.add_column(column)
        for row in self._rows.values():
            share = "all" if row["expert_share"] is None else f"{100 * row['expert_share']:.1f} %"
            level = _interval(row["success"]), _interval(row["score"])
            table.add_row(str(row["round"]), str(row["episodes"]), share, *level, f"{row['seconds'] / 60:.1f} min")
        level = _interval(self._expert["success"]), _interval(self._expert["score"])
        table.add_row("", "", self._stages.expert, *level, "")
        self._console.print(table)
        policy = self._policy(max(self._rows))
        evaluation = command(self._config.evaluation, {"brains.policy.type": "learned", "brains.policy.path": policy})
        self._console.print(
            f"Policies, data and curve: {self._folder}. Evaluate the last policy on unused episodes:\n"
            f"  {shlex.join(['bhd-eval', *evaluation])}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )

    # --- steps -------------------------------------------------------------------------------------------------------

    def _record(self, number: int, folder: Path) -> None:
        config = self._config
        stage, episodes = (config.learner, config.episodes) if number else (config.expert, config.expert_episodes)
        own: dict[str, Any] = {
            "dataset.root": folder / "data",
            "dataset.num_episodes": episodes,
            "dataset.push_to_hub": "false",
            "seed": 1000 * config.seed + number,  # no two rounds meet the same episode
            "resume": "true",
            "output_dir": folder / "recording",
        }
        if number:
            own["brain.learner.path"] = self._policy(number - 1)
        else:  # as in those of the other rounds, which it is merged with
            own["dataset.expert_action"] = str(self._stages.has_advice).lower()
        self._call(number, "bhd-record", command(stage, own))

    def _train(self, number: int, folder: Path) -> None:
        run_folder = folder / "policy"
        if (last := last_checkpoint(run_folder)) is not None:
            if int(last.name) >= self._stages.steps:
                return  # it was stopped between its last checkpoint and the note of it
            data = f"--dataset.root={self._data_at(number, folder)}"  # the run may have been moved
            self._call(number, "bhd-train", ["--resume=true", f"--config_path={last}", data])
            return
        shutil.rmtree(run_folder, ignore_errors=True)
        own: dict[str, Any] = {
            "dataset.root": self._data(number, folder),
            "output_dir": run_folder,
            "seed": self._config.seed,
            "policy.push_to_hub": "false",
        }
        if self._stages.has_advice:
            own["selection.expert_action"] = "true"
        elif number or self._config.data:  # which may have been recorded with takeovers, too
            own["selection.learner_weight"] = 0
        self._call(number, "bhd-train", command(self._config.policy, own))

    def _data_at(self, number: int, folder: Path) -> Path:
        """Return where the dataset of all rounds so far is."""
        return folder / ("all" if number or self._config.data else "data")

    def _data(self, number: int, folder: Path) -> Path:
        """Return the dataset of all rounds so far, after merging them if there are several."""
        target = self._data_at(number, folder)
        if target.name == "data":
            return target
        parts = [self._folder / f"round_{one}" / "data" for one in range(number + 1)]
        parts += [Path(root).expanduser() for root in self._config.data]
        # Merging is quick, and a merge that was cut short leaves nothing.
        shutil.rmtree(target, ignore_errors=True)
        self._say(number, f"merge {' '.join(map(str, parts))}")
        if twice := sum(map(len, merge(parts, target).left_out.values())):
            self._say(number, f"leave out {twice} episodes that are in these datasets more than once")
        return target

    def _evaluate(self, number: int, folder: Path) -> None:
        target = folder / "evaluation"
        shutil.rmtree(target, ignore_errors=True)
        own: dict[str, Any] = {
            "brains.policy.type": "learned",
            "brains.policy.path": self._policy(number),
            "only": "[policy]" if number else "[expert, policy]",
            "baseline": "policy" if number else "expert",
            "split": "validation",
            "n_episodes": self._config.validation_episodes,
            "videos": 0,
            "output_dir": target,
        }
        if not number:
            own["brains.expert"] = json.dumps(self._stages.brain)
        self._call(number, "bhd-eval", command(self._config.evaluation, own))

    def _policy(self, number: int) -> Path:
        return self._folder / f"round_{number}" / "policy"

    # --- programs ----------------------------------------------------------------------------------------------------

    def _call(self, number: int, program: str, arguments: Sequence[str]) -> None:
        self._say(number, shlex.join([program, *arguments]))
        status = _PROGRAMS[program](arguments)
        if status:
            again = (
                "the same command continues there"
                if status > _SIGNALLED
                else "when the cause is resolved, the same command repeats this step"
            )
            self._console.print(
                f"Round {number}: {program} ended with status {status}. What is done is kept in {self._folder}; "
                f"{again}.",
                soft_wrap=True,
                highlight=False,
            )
            raise _StoppedError(status)

    def _say(self, number: int, what: str) -> None:
        self._console.print(f"round {number}: {what}", style="bold", soft_wrap=True, markup=False, highlight=False)

    # --- results -----------------------------------------------------------------------------------------------------

    def _row(self, number: int, folder: Path) -> dict[str, Any]:
        results = json.loads((folder / "evaluation" / "results.json").read_text(encoding="utf-8"))["brains"]
        if not number:
            self._expert = _level(results["expert"])
        summary = dataset_info(folder / "data")
        driven = sum(episode.metadata.get("intervened_frames") or 0 for episode in summary.episodes)
        share = driven / summary.frames if number else None
        merged = folder / "all"
        learned = dataset_info(merged) if merged.exists() else summary
        return {
            "round": number,
            "episodes": len(learned.episodes),
            "frames": learned.frames,
            "expert_share": share,
            "seconds": self._seconds,
            **_level(results["policy"]),
        }


def _note(folder: Path) -> dict[str, Any]:
    """Return which steps of a round are done, and how long they took so far [s]."""
    folder.mkdir(exist_ok=True)
    try:
        values = json.loads((folder / _DONE).read_text(encoding="utf-8"))
        return {"done": list(values["done"]), "seconds": float(values["seconds"])}
    except FileNotFoundError:
        return {"done": [], "seconds": 0.0}
    except (ValueError, TypeError, KeyError) as error:
        raise BhdError(
            f"{folder / _DONE} cannot be read: {error}. Remove the folder {folder}, and its round is repeated."
        ) from error


def _reported(folder: Path) -> dict[int, dict[str, Any]]:
    """Return the rows of `rounds.json`, by their rounds; none if it cannot be read: each round makes its own anew."""
    file = folder / ROUNDS
    try:
        return {row["round"]: row for row in json.loads(file.read_text(encoding="utf-8"))["rounds"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _level(brain: dict[str, Any]) -> dict[str, Any]:
    return {"success": brain["success"], "score": brain["means"]["score"], "outcomes": brain["outcomes"]}


def _interval(one: dict[str, float]) -> str:
    return f"{one['value']:.3f} ({one['low']:.3f} to {one['high']:.3f})"


_KEPT = "Stopped; what is done is kept, and the same command continues there."
PROGRAM = Program(AggregationConfig, train, parse_aggregation, _KEPT)
