"""The report of an evaluation: one HTML file that holds everything it shows, charts and videos included."""

import base64
import hashlib
import io
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import yaml

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
    cite = ("How to cite and repeat", "cite", _cite(given))
    shown = [section for section in _sections(given) if section[2]] if given.results.episodes else []
    shown.append(cite)
    links = "".join(f'<a href="#{key}">{title}</a>' for title, key, _ in shown)
    facts = given.results.config
    where = _environment(facts) or f"{facts['task']['type'].capitalize()} with {facts['robot']['type']}"
    title = f"{where}: {_listed(list(given.results.brains))}"
    template = Template(resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8"))
    page = template.substitute(
        title=escape(title),
        lead=_lead(given) + f"<nav>{links}</nav>",
        sections="\n".join(f'<section id="{key}"><h2>{title}</h2>\n{body}</section>' for title, key, body in shown),
        footer=f"Made {escape(given.timing['made'])} by bhd-eval, bhd_lerobot "
        f"{escape(given.results.versions['bhd_lerobot'])}. This file needs no network and no other file.",
    )
    path.write_text(page, encoding="utf-8")


def _sections(given: ReportInput) -> list[tuple[str, str, str]]:
    """Return title, anchor and content of each section about episodes; a section without content is empty."""
    return [
        ("Summary", "summary", _summary(given)),
        ("Beside the baseline", "paired", _paired(given)),
        ("How episodes ended", "outcomes", _outcomes(given)),
        ("What was seen", "perception", _perception(given)),
        ("Distributions", "distributions", _distributions(given)),
        ("Limits and stops", "safety", _safety(given)),
        ("From above", "trajectories", _trajectories(given)),
        ("Videos", "videos", _videos(given)),
        ("Failed episodes", "failures", _failures(given)),
        ("Time to decide", "latency", _latency(given)),
    ]


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


def _lead(given: ReportInput) -> str:
    results, facts = given.results, given.results.config
    count = len(results.brains)
    lead = f"<p>{count} brain{'s' * (count != 1)} on the same {results.requested} "
    if where := _environment(facts):
        lead += (
            f"episodes of {escape(where)}: the same seeds, {facts['seed']} for the first. Rolled out by LeRobot, "
            f"{facts['n_envs']} at a time.</p>"
        )
        if not facts["says_success"]:
            lead += f'<p class="warn">{NO_SUCCESS}</p>'
    else:
        clock = "on the wall clock" if given.timing["clock"] == "realtime" else "in simulated time"
        lead += (
            f"{facts['split'].replace('_', '-')} "
            f"episodes, {clock}{_sameness(given)} "
            f"Robot {escape(facts['robot']['type'])}, {facts['fps']} decisions a second, run seed {facts['seed']}.</p>"
        )
    if given.config.sequential:
        lead += f"<p>{escape(sequential_sentence(results))}</p>"
    if results.is_partial:
        ran = ", ".join(f"{escape(label)} {one.episodes}" for label, one in results.brains.items())
        lead += f'<p class="warn"><b>Partial:</b> the run was stopped early. Episodes finished: {ran}.</p>'
    return (
        lead
        + "<ul class='found'>"
        + "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences(results))
        + "</ul>"
    )


def _sameness(given: ReportInput) -> str:
    """Return what the brains had in common."""
    if not given.config.by_person:
        return ": the same scenes, the same sensor noise, the same initial states."
    return (
        ". A person set up the scenes. Every brain ran in a scene before the next was set up, in an order drawn at "
        "random for each scene, and no prompt said which one ran."
    )


def _summary(given: ReportInput) -> str:
    results = given.results
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
        cells = [cell(percent(one.success), f"{one.successes} of {one.episodes}")]
        for _, name, digits in columns:
            mean = one.means[name]
            cells.append(cell(significant(mean) if digits is None else number(mean, digits)))
        rows.append((label, cells))
    head = ["success", *(heading for heading, _, _ in columns)]
    note = "In brackets 95 % intervals: Wilson's for success rates, Student's, corrected for skewness, for means. "
    if "jerk" in facts:
        note += (
            f"Jerk is that of the commanded motion ({facts['jerk']}), from frame to frame; “largest” is the mean over "
            f"episodes of each one's largest.<br>{_score_note(results.brains)}"
        )
    note += f"<br>{mark} Return: the sum of an episode's rewards, which the task defines."
    if "jerk" in facts:
        note += " Unlike a score it has no bounds, so that it, or its interval, can go below 0 or beyond 1."
    privileged = {label for label, one in results.brains.items() if one.privileged}
    if privileged:
        note += (
            " Privileged state: the brain acts on what the task reports of the simulator's true state "
            "(<code>observation.environment_state</code>), which no sensor measures."
        )
    drawn = chart(plots.forest(results.brains, results.config["baseline"]), "Success rates and means with intervals")
    return drawn + table(head, rows, results.config["baseline"], privileged) + f'<p class="note">{note}</p>'


def _score_note(brains: Mapping[str, BrainSummary]) -> str:
    """Return why the interval of a score is wider than the scores differ, with the numbers of a brain."""
    note = (
        "¹ Score: from 0 to 1. Its interval reaches further than the scores of the episodes vary, because it also "
        "holds what rare episodes would do that so few easily leave unseen"
    )
    label, one = max(brains.items(), key=lambda item: item[1].episodes)
    if one.episodes < 2:
        return f"{note}."
    unseen, score = unseen_share(one.episodes), one.means["score"]
    return (
        f"{note}: {one.episodes} episodes prove little about what happens in up to {100 * unseen:.0f} % of all. If "
        f"those scored 0, the mean score of {escape(label)} would be {(1 - unseen) * score.value:.3f}; if they "
        f"scored 1, {score.value + unseen * (1 - score.value):.3f}. More episodes make it narrower."
    )


def _paired(given: ReportInput) -> str:
    results = given.results
    if not results.paired:
        return ""
    baseline = results.config["baseline"]
    rows = []
    for label, one in results.paired.items():
        cells = [
            cell(percent(one.success, sign=True)),
            f"{one.differ.better} better, {one.differ.worse} worse",
            f"{one.differ.p:.2g}",
            *([] if one.rewards else [cell(number(one.score, 3, sign=True)), cell(number(one.ratio, 3))]),
            *(cell(number(reward, 3, sign=True)) for reward in one.rewards.values()),
            str(one.episodes),
        ]
        rows.append((label, cells))
    rewards = any(one.rewards for one in results.paired.values())
    of_means, more = ["return, difference", "largest reward, difference"], ""
    if not rewards:
        of_means = ["score, difference ¹", "score, ratio ¹"]
        more = ", Fieller's for ratios; those of scores also hold what rare episodes would do, see ¹ above"
    p_name = "p" if given.config.sequential else "McNemar p"
    head = ["success, difference", "episodes that differ", p_name, *of_means, "episodes"]
    rates, p = (
        ("the confidence sequence of bets", "1 / e-value of the sequential test")
        if given.config.sequential
        else ("Newcombe's method 10", "that of McNemar's exact test, two-sided")
    )
    note = (
        f"Every brain compared with {escape(baseline)}, episode by episode. Intervals: {rates} for paired rates, "
        f"Student's, corrected for skewness, for differences of means{more}. p is {p}; where it finds "
        "no difference, the interval of the rates holds 0. An interval that excludes the dashed line shows a "
        "difference beyond chance"
        + (f": with 95 % confidence all {len(rows)} brains' intervals hold at once." if len(rows) > 1 else ".")
    )
    drawn = chart(plots.paired_forest(results.paired), f"Differences from {baseline} with intervals")
    return drawn + table(head, rows) + f'<p class="note">{note}</p>'


def _outcomes(given: ReportInput) -> str:
    return chart(plots.outcome_bars(given.results.brains), "How the episodes of each brain ended")


def _perception(given: ReportInput) -> str:
    rows = []
    for label, brain in given.results.brains.items():
        one = brain.perception
        if one is None:
            continue
        median, most, worst = (f"{1000 * value:.1f}" for value in one.error_m)
        cells = [
            cell(percent(one.chosen)),
            cell(percent(one.wrong)),
            f"{median}<br><span class='ci'>90 %: {most}, 99 %: {worst}</span>",
            cell(percent(one.in_50)),
            cell(percent(one.in_90)),
            cell(percent(one.seen)),
            cell(percent(one.named)),
            str(one.phantoms),
        ]
        rows.append((label, cells))
    if not rows:
        return ""
    head = ["chose an object", "the wrong one", "median error [mm]", "within its 50 % radius", "within its 90 % radius"]
    head += ["objects seen", "kind and colour right", "objects that are none"]
    note = (
        "For brains with perception: their estimates at the episode's start, compared with the true poses, in x and "
        "y. If a brain's stated errors are calibrated, it is within the radius that it states for 50 % in half of the "
        "episodes. In brackets Wilson's 95 % intervals."
    )
    return table(head, rows) + f'<p class="note">{note}</p>'


def _distributions(given: ReportInput) -> str:
    note = "Each mark is an episode: a dot a success, a cross a failure. Box: the middle half, and the median."
    columns = [("return", "reward"), ("largest reward", "max_reward"), ("length [s]", "length_s")]
    if "jerk_unit" in (facts := given.results.config):
        columns = [("score", "score"), ("length [s]", "length_s"), ("path [m]", "path_m")]
        columns.append((f"mean jerk [{facts['jerk_unit']}]", "jerk_mean"))
    drawn = chart(plots.distributions(_by_brain(given), columns), f"Distributions: {', '.join(dict(columns))}")
    return f'{drawn}<p class="note">{note}</p>'


def _safety(given: ReportInput) -> str:
    brains = given.results.brains
    if _environment(given.results.config):
        return ""

    def occurring(kind: str) -> list[str]:
        return [name for name in getattr(next(iter(brains.values())), kind, {}) if any(
            getattr(brain, kind).get(name) for brain in brains.values())]  # fmt: skip

    limits, watchdogs = occurring("limits"), occurring("watchdogs")
    rows = []
    for label, one in brains.items():
        cells = [share(one.limits.get(name, 0), one) for name in limits]
        cells += [share(one.watchdogs.get(name, 0), one) for name in watchdogs]
        rows.append((label, [*cells, str(one.estops), str(one.faults), str(one.frames)]))
    head = [f"{name} limited" for name in limits] + [f"watchdog: {name.replace('_', ' ')}" for name in watchdogs]
    note = (
        "Share of the frames in which the safety filter changed the command, by kind of limit, and in which a "
        "watchdog was triggered; kinds that never occurred are left out. Emergency stops and faults count episodes."
    )
    return table([*head, "emergency stops", "faults", "frames"], rows) + f'<p class="note">{note}</p>'


def _trajectories(given: ReportInput) -> str:
    ran = {label: one for label, one in given.trajectories.items() if one}
    if not ran:
        return ""
    note = (
        "A column is an episode, a row a brain; above each panel the episode, how it ended, and its score. Half of "
        "them are episodes that ended unlike most of a brain's, if there are any; the others are the first. "
        "Solid blue: success; dashed orange with a cross: failure."
    )
    return f'<p class="note">{note}</p>' + chart(plots.trajectory_grid(ran), "Trajectories from above")


def _videos(given: ReportInput) -> str:
    if not given.videos:
        return f'<p class="note">No videos: {escape(given.no_videos or "no episode was finished.")}</p>'
    room, figures = VIDEO_BYTES, []
    for video in given.videos:
        content = video.path.read_bytes()
        room -= len(content)
        data = base64.b64encode(content).decode("ascii") if room >= 0 else ""
        player = (
            f'<video controls muted playsinline preload="metadata" poster="{_last_image(video.path)}" '
            f'src="data:video/mp4;base64,{data}"></video>'
        )
        name = escape(str(video.path.relative_to(given.folder)))
        ended = video.metrics.outcome.replace("_", " ")
        figures.append(
            f"<figure>{player if data else ''}<figcaption><b>{escape(video.label)}</b>, "
            f"episode {video.metrics.episode}: {ended}, after {video.metrics.length_s:.1f} s. "
            f"File {name}{'' if data else ', too large for this page'}.</figcaption></figure>"
        )
    note = "The first failures of each brain; of a brain without failures its first episode. The image is the end."
    return f'<p class="note">{note}</p><div class="videos">{"".join(figures)}</div>'


def _last_image(video: Path) -> str:
    """Return how a video ends, as a JPEG for a page."""
    import av

    with av.open(str(video)) as container:
        *_, last = container.decode(video=0)
        image = io.BytesIO()
        last.to_image().save(image, format="JPEG", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(image.getvalue()).decode('ascii')}"


def _failures(given: ReportInput) -> str:
    what, heading = ("reward", "return") if _environment(given.results.config) else ("score", "score")
    parts = []
    for label, episodes in _by_brain(given).items():
        failed = [episode for episode in episodes if not episode.success]
        if not failed:
            parts.append(f"<p><b>{escape(label)}</b>: none.</p>")
            continue
        rows = [
            f"<tr><td>{one.episode}</td><td>{one.outcome.replace('_', ' ')}</td><td>{getattr(one, what):.3f}</td>"
            f"<td>{one.length_s:.1f}</td><td><code>{one.seed}</code></td>"
            f"<td><code>{escape(replay_command(given.config, given.folder, one))}</code>{_why(one)}</td></tr>"
            for one in failed[:LISTED]
        ]
        head = "<tr>" + "".join(f"<th>{h}</th>" for h in ("episode", "ended by", heading, "s", "seed", "run it again"))
        more = "" if len(failed) <= LISTED else f'<p class="note">{len(failed) - LISTED} more in episodes.parquet.</p>'
        parts.append(
            f"<details{' open' if len(failed) <= 10 else ''}><summary>{escape(label)}: {len(failed)} of {len(episodes)}"
            f'</summary><div class="scroll"><table>{head}</tr>{"".join(rows)}</table></div>{more}</details>'
        )
    return "".join(parts)


def _why(one: EpisodeMetrics) -> str:
    return f"<br>{escape(one.problem)}" if one.problem else ""


def _latency(given: ReportInput) -> str:
    rows = []
    for label, one in given.timing["brains"].items():
        act = one["act"]
        cells = [ms(act[name]) for name in ("p50_s", "p99_s", "max_s")]
        cells += [f"{act['calls']}", f"{act['robots_per_call']}"]
        rows.append((label, [*cells, f"{one['episodes_per_s']:.2f}", f"{one['real_time_factor']:.0f} ×"]))
    head = ["p50 [ms]", "p99 [ms]", "longest [ms]", "calls", "robots a call", "episodes a second", "speed"]
    note = (
        "Wall-clock time of one call of the brain, which decides for all simulations that run side by side. For the "
        "time that one robot waits, evaluate with --n_envs=1."
    )
    return table(head, rows) + f'<p class="note">{note}</p>' if rows else ""


def _cite(given: ReportInput) -> str:
    results = given.results
    facts = results.config
    digest = hashlib.sha256((given.folder / "results.json").read_bytes()).hexdigest()
    command = shlex.join(["bhd-eval", f"--config_path={given.folder / 'config.yaml'}"])
    versions = ", ".join(f"{name} {version}" for name, version in results.versions.items())
    shown = yaml.safe_dump(encode(given.config), sort_keys=False, allow_unicode=True)
    again = "gives" if given.timing["clock"] == "lockstep" else "measures again, on the wall clock, what is in"
    return (
        f"<pre>{escape(command)}</pre>"
        f"<p>{escape(versions)}.<br>{_seeds(facts)}</p>"
        f"<p>The same command with the same versions {again} the same <code>results.json</code>, SHA-256 "
        f"<code>{digest}</code>. Beside this file: <code>results.json</code> (everything), "
        "<code>episodes.parquet</code> (a row for each episode), "
        f"{'' if 'env' in facts else '<code>initial_states.npz</code>, '}"
        "<code>timing.json</code> (wall clock), <code>config.yaml</code>.</p>"
        f"<details><summary>config.yaml</summary><pre>{escape(shown)}</pre></details>"
    )


def _seeds(facts: Mapping[str, Any]) -> str:
    """Return which episodes were run, and how their seeds follow."""
    if "env" in facts:
        return (
            f"Episode i of a task has the seed {facts['seed']} + i, as with <code>lerobot-eval --seed={facts['seed']} "
            f"--eval.n_episodes={facts['n_episodes']} --eval.batch_size={facts['n_envs']} "
            "--eval.use_async_envs=false</code>."
        )
    numbers = facts["episodes"]
    which = f"{numbers[0]} to {numbers[-1]}" if len(numbers) == numbers[-1] - numbers[0] + 1 else str(numbers)
    return (
        f"Episodes {which} of run seed {facts['seed']}, split {facts['split']}; episode i "
        "has the seed <code>episode_seed(seed, i, split)</code> of <code>bhd_lerobot.tasks.task</code>."
    )


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


def cell(text: str, below: str = "") -> str:
    """Return a cell: a number, its interval below it, and something below that."""
    value, bracket, interval = text.partition(" (")
    lines = [value, f'<span class="ci">({interval}</span>' if bracket else "", f'<span class="ci">{below}</span>']
    return "<br>".join(line for line in lines if line and line != '<span class="ci"></span>')


def table(
    head: list[str],
    rows: list[tuple[str, list[str]]],
    baseline: str | None = None,
    privileged: Collection[str] = (),
) -> str:
    """Return a table with a row for each brain; the baseline's is marked, and those that use a privileged state."""
    badge = ' <span class="badge">privileged state</span>'
    top = "".join(f"<th>{escape(one)}</th>" for one in ["brain", *head])
    body = "".join(
        f"<tr{' class=baseline' if label == baseline and len(rows) > 1 else ''}><td class='name'>{escape(label)}"
        f"{badge if label in privileged else ''}</td>" + "".join(f"<td>{text}</td>" for text in cells) + "</tr>"
        for label, cells in rows
    )
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def chart(source: str, text: str) -> str:
    """Return an image with words for those who do not see it."""
    return f'<div class="scroll wide"><img class="chart" src="{source}" alt="{escape(text)}"></div>'
