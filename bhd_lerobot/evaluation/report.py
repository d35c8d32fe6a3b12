"""The report of an evaluation: one HTML file that holds everything it shows, charts and videos included."""

import base64
import hashlib
import io
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, StrictUndefined

from bhd_lerobot.datasets.timing import ms
from bhd_lerobot.evaluation import plots
from bhd_lerobot.evaluation.config import Comparison
from bhd_lerobot.evaluation.metrics import EpisodeMetrics
from bhd_lerobot.evaluation.results import BrainSummary, EvalResults
from bhd_lerobot.evaluation.statistics import Estimate, unseen_share
from bhd_lerobot.evaluation.text import number, percent, sentences, sequential_sentence
from bhd_lerobot.options.parse import encode
from bhd_lerobot.rollout.plots import Trajectory

VIDEO_BYTES = 12_000_000  # videos in the page; those beyond stay files beside it
NO_SUCCESS = (
    "The environment does not report is_success, and LeRobot's evaluation counts such an episode as a success. Only "
    "the rewards say anything."
)
"""What is reported of an environment of LeRobot whose episodes end without a judgement."""
LISTED = 100  # failed episodes of a brain that are listed


@dataclass(frozen=True)
class Video:
    """A video of a brain's episode."""

    label: str
    metrics: EpisodeMetrics
    path: Path


@dataclass(frozen=True)
class ReportInput:
    """What a report is made of; `no_videos` reports why there are none."""

    config: Comparison
    results: EvalResults
    timing: dict[str, Any]
    trajectories: Mapping[str, Mapping[int, Trajectory]]
    videos: list[Video]
    no_videos: str
    folder: Path


def write_report(given: ReportInput, path: Path) -> None:
    """Write the report."""
    results, facts, folder = given.results, given.results.config, given.folder
    environment = _environment(facts)
    where = environment or f"{facts['task']['type'].capitalize()} with {facts['robot']['type']}"
    pages = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = pages.from_string(resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8"))
    page = template.render(
        plots=plots,
        title=f"{where}: {_listed(list(results.brains))}",
        config=given.config,
        results=results,
        brains=results.brains,
        baseline=facts.get("baseline"),
        facts=facts,
        timing=given.timing,
        env=environment,
        no_success=NO_SUCCESS,
        sequential=sequential_sentence(results) if given.config.sequential else "",
        sentences=sentences(results),
        sections=_sections(given),
        by_brain=_by_brain(given),
        privileged={label for label, one in results.brains.items() if one.privileged},
        summary_table=_summary(results) if results.episodes else None,
        unseen=_unseen(results) if results.episodes and not environment else None,
        paired_table=_paired(given),
        perception_rows=_perception(results),
        spread=_spread(facts),
        safety_table=_safety(results),
        drawn={label: one for label, one in given.trajectories.items() if one},
        films=_films(given),
        no_videos=given.no_videos,
        listed=LISTED,
        replay=partial(replay_command, given.config, folder),
        latency_rows=_latency(given.timing),
        command=shlex.join(["bhd-eval", f"--config_path={folder / 'config.yaml'}", f"--output_dir={folder}_again"]),
        numbers="" if environment else _range(facts["episodes"]),
        digest=hashlib.sha256((folder / "results.json").read_bytes()).hexdigest(),
        yaml=yaml.safe_dump(encode(given.config), sort_keys=False, allow_unicode=True),
    )
    path.write_text(page, encoding="utf-8")


def _sections(given: ReportInput) -> dict[str, str]:
    """Return the titles of the sections that have something to show, by their anchors."""
    results = given.results
    shown: dict[str, tuple[str, Any]] = {
        "summary": ("Summary", True),
        "paired": ("Beside the baseline", results.paired),
        "outcomes": ("How episodes ended", True),
        "perception": ("What was seen", _perception(results)),
        "distributions": ("Distributions", True),
        "safety": ("Limits and stops", not _environment(results.config)),
        "trajectories": ("From above", any(given.trajectories.values())),
        "videos": ("Videos", True),
        "failures": ("Failed episodes", True),
        "latency": ("Time to decide", given.timing["brains"]),
    }
    titles = {key: title for key, (title, has) in shown.items() if has and results.episodes}
    return titles | {"cite": "How to cite and repeat"}


def replay_command(config: Comparison, folder: Path, one: EpisodeMetrics) -> str:
    """Return the command that runs a single episode again; it leaves a video where images can be rendered."""
    options = [
        f"--config_path={folder / 'config.yaml'}",
        f"--only=[{one.brain}]",
        *config.again(one.episode),
        f"--output_dir={folder / f'{one.brain}_{one.episode:04d}'}",
    ]
    if config.record.repo_id is not None:
        options += ["--record.repo_id=null", "--record.root=null"]
    if config.sequential:
        options.append("--sequential=false")
    if config.fail_below is not None:
        options.append("--fail_below=null")  # one episode proves no rate
    return shlex.join(["bhd-eval", *options])


Table = tuple[list[str], list[tuple[str, list[Any]]]]
"""Headings, and a row for each brain: its name and its cells, each a text, or with what stands below it."""


def _summary(results: EvalResults) -> Table:
    facts = results.config
    unit, mark = facts.get("jerk_unit"), "²" if "jerk" in facts else "¹"
    columns: list[tuple[str, str, int | None]] = [
        ("score ¹", "score", 3),
        ("length [s]", "length_s", 1),
        ("path [m]", "path_m", 2),
        (f"mean jerk [{unit}]", "jerk_mean", None),
        (f"largest jerk [{unit}]", "jerk_max", None),
        (f"return {mark}", "reward", 3),
        ("largest reward", "max_reward", 3),
    ]
    columns = [column for column in columns if column[1] in results.brains[facts["baseline"]].means]
    rows = []
    for label, one in results.brains.items():
        cells: list[Any] = [(percent(one.success), f"{one.successes} of {one.episodes}")]
        for _, name, digits in columns:
            mean = one.means[name]
            cells.append(significant(mean) if digits is None else number(mean, digits))
        rows.append((label, cells))
    return ["success", *(heading for heading, _, _ in columns)], rows


def _unseen(results: EvalResults) -> dict[str, Any]:
    """Return, of a brain, by how much episodes that were left unseen could change its score: why intervals are wide."""
    label, one = max(results.brains.items(), key=lambda item: item[1].episodes)
    share, score = unseen_share(one.episodes), one.means["score"].value
    ends = {"low": (1 - share) * score, "high": score + share * (1 - score)}
    return {"label": label, "episodes": one.episodes, "share": share, **ends}


def _paired(given: ReportInput) -> Table:
    results = given.results
    rows = []
    for label, one in results.paired.items():
        cells = [
            percent(one.success, sign=True),
            f"{one.differ.better} better, {one.differ.worse} worse",
            f"{one.differ.p:.2g}",
            *([] if one.rewards else [number(one.score, 3, sign=True), number(one.ratio, 3)]),
            *(number(reward, 3, sign=True) for reward in one.rewards.values()),
            str(one.episodes),
        ]
        rows.append((label, cells))
    means = ["score, difference ¹", "score, ratio ¹"]
    if _environment(results.config):
        means = ["return, difference", "largest reward, difference"]
    p_name = "p" if given.config.sequential else "McNemar p"
    return ["success, difference", "episodes that differ", p_name, *means, "episodes"], rows


def _perception(results: EvalResults) -> list[tuple[str, list[Any]]]:
    rows: list[tuple[str, list[Any]]] = []
    for label, one in ((label, brain.perception) for label, brain in results.brains.items()):
        if one is not None:
            median, most, worst = (f"{1000 * value:.1f}" for value in one.error_m)
            shares = [percent(share) for share in (one.chosen, one.wrong, one.in_50, one.in_90, one.seen, one.named)]
            error = (median, f"90 %: {most}, 99 %: {worst}")
            rows.append((label, [*shares[:2], error, *shares[2:], str(one.phantoms)]))
    return rows


def _spread(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the numbers whose distributions are drawn, by their headings."""
    if "jerk_unit" not in facts:
        return [("return", "reward"), ("largest reward", "max_reward"), ("length [s]", "length_s")]
    columns = [("score", "score"), ("length [s]", "length_s"), ("path [m]", "path_m")]
    return [*columns, (f"mean jerk [{facts['jerk_unit']}]", "jerk_mean")]


def _safety(results: EvalResults) -> Table:
    brains = results.brains
    kinds = [
        (kind, name)
        for kind in ("limits", "watchdogs")
        for name in dict.fromkeys(name for one in brains.values() for name in getattr(one, kind))
        if any(getattr(one, kind).get(name) for one in brains.values())
    ]
    rows = []
    for label, one in brains.items():
        cells = [share(getattr(one, kind).get(name, 0), one) for kind, name in kinds]
        rows.append((label, [*cells, str(one.estops), str(one.faults), str(one.frames)]))
    head = [f"{name} limited" if kind == "limits" else f"watchdog: {name.replace('_', ' ')}" for kind, name in kinds]
    return [*head, "emergency stops", "faults", "frames"], rows


def _films(given: ReportInput) -> list[dict[str, Any]]:
    """Return the videos, with their content and last image while there is room for them in the page."""
    room, films = VIDEO_BYTES, []
    for one in given.videos:
        content = one.path.read_bytes()
        room -= len(content)
        data = f"data:video/mp4;base64,{base64.b64encode(content).decode('ascii')}" if room >= 0 else ""
        poster = _last_image(one.path) if data else ""
        name = one.path.relative_to(given.folder)
        films.append({"label": one.label, "metrics": one.metrics, "name": name, "data": data, "poster": poster})
    return films


def _latency(timing: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    rows = []
    for label, one in timing["brains"].items():
        act = one["act"]
        cells = [*(ms(act[name]) for name in ("p50_s", "p99_s", "max_s")), f"{act['calls']}"]
        cells += [f"{act['robots_per_call']}", f"{one['episodes_per_s']:.2f}", f"{one['real_time_factor']:.0f} ×"]
        rows.append((label, cells))
    return rows


def _range(numbers: Sequence[int]) -> str:
    is_whole = len(numbers) == numbers[-1] - numbers[0] + 1
    return f"{numbers[0]} to {numbers[-1]}" if is_whole else str(numbers)


def _last_image(video: Path) -> str:
    """Return how a video ends, as a JPEG for a page."""
    import av

    with av.open(str(video)) as container:
        *_, last = container.decode(video=0)
        image = io.BytesIO()
        last.to_image().save(image, format="JPEG", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(image.getvalue()).decode('ascii')}"


def _environment(facts: Mapping[str, Any]) -> str:
    """Return which environment of LeRobot the episodes were run in; empty if they were run in none."""
    env = facts.get("env")
    return f"{env['type']} {env.get('task') or ''}".strip() if env else ""


def _by_brain(given: ReportInput) -> dict[str, list[EpisodeMetrics]]:
    return {
        label: [episode for episode in given.results.episodes if episode.brain == label]
        for label in given.results.brains
    }


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def share(count: int, one: BrainSummary) -> str:
    """Return a number of a brain's frames as a share of all of them."""
    return f"{100 * count / one.frames:.1f} %" if one.frames else "–"


def significant(estimate: Estimate) -> str:
    """Return a number with its interval, with digits that fit its size."""
    size = abs(estimate.value)
    return number(estimate, 0 if size >= 100 else 1 if size >= 10 else 2)
