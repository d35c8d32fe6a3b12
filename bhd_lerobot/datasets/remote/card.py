"""The card of a dataset: `README.md` beside it, by which people and the Hub's viewer know what it is. Pure text."""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from bhd_lerobot.datasets.format.summary import DatasetSummary

LEROBOT_TAG = "LeRobot"
"""By this tag LeRobot's viewer finds datasets."""

_SIGNATURE = re.compile(r"\n<!-- bhd-card ([0-9a-f]{64}) -->\n\Z")


@dataclass(frozen=True)
class CardFacts:
    """What a card says.

    Attributes:
        title: the heading.
        summary: the dataset.
        features: name, type, shape and meaning of each column.
        outcomes: how many episodes ended how, most frequent first.
        success: the share of successes in words, with its interval; empty if nothing is known.
        picture: the picture's path beside the card, and what it shows; None if there is none.
        repo_id: its name on the Hub; None if it lies elsewhere.
        url: where it lies, if not on the Hub.
        hub: address of the Hub.
        identity: content of `meta/bhd.json`; empty if another program recorded it.
        licence: identifier of the licence, as the Hub knows them.
        tags: further tags.
    """

    title: str
    summary: DatasetSummary
    features: Sequence[tuple[str, str, str, str]]
    outcomes: Mapping[str, int] = field(default_factory=dict)
    success: str = ""
    picture: tuple[str, str] | None = None
    repo_id: str | None = None
    url: str = ""
    hub: str = ""
    identity: Mapping[str, Any] = field(default_factory=dict)
    licence: str = "apache-2.0"
    tags: Sequence[str] = ()


def compose(facts: CardFacts) -> str:
    """Return the card, signed, so that `is_generated` can tell whether somebody edited it."""
    parts = [
        _front_matter(facts),
        f"# {facts.title}",
        _introduction(facts),
        *([f"![{facts.picture[1]}]({facts.picture[0]})\n\n{facts.picture[1]}."] if facts.picture else []),
        _overview(facts),
        "## Outcomes\n\n" + _outcomes(facts) if facts.outcomes else "",
        "## Columns\n\n" + _table(("key", "type", "shape", "meaning and unit"), facts.features),
        "## Loading it\n\n" + _loading(facts),
        _origin(facts),
    ]
    return sign("\n\n".join(part for part in parts if part) + "\n")


def sign(text: str) -> str:
    """Return a text with the checksum of itself at its end."""
    return f"{text}\n<!-- bhd-card {hashlib.sha256(text.encode()).hexdigest()} -->\n"


def is_generated(text: str) -> bool:
    """Return whether a card was written by `compose` and nobody changed it since."""
    text = text.replace("\r\n", "\n")
    found = _SIGNATURE.search(text)
    return found is not None and hashlib.sha256(text[: found.start()].encode()).hexdigest() == found[1]


def _front_matter(facts: CardFacts) -> str:
    robot = facts.summary.robot_type
    task = facts.summary.recording.get("task", {}).get("type")
    named = [name for name in ("bhd_lerobot" if facts.identity else None, robot, task) if name]
    tags = list(dict.fromkeys([LEROBOT_TAG, *named, *facts.tags]))
    values = {
        "license": facts.licence,
        "task_categories": ["robotics"],
        "tags": tags,
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    return f"---\n{yaml.safe_dump(values, sort_keys=False, allow_unicode=True)}---"


def _introduction(facts: CardFacts) -> str:
    summary = facts.summary
    robot = f" of the robot `{summary.robot_type}`" if summary.robot_type else ""
    lines = [f"{_some(len(summary.episodes), 'episode')}{robot}, a LeRobotDataset of format v3.0."]
    if facts.repo_id and facts.hub:
        lines.append(
            f"[Look at it in LeRobot's viewer]({facts.hub}/spaces/lerobot/visualize_dataset?path={facts.repo_id})."
        )
    return " ".join(lines)


def _overview(facts: CardFacts) -> str:
    summary = facts.summary
    rows = [
        ("robot", summary.robot_type or "not said"),
        ("frames a second", str(summary.fps)),
        ("episodes", str(len(summary.episodes))),
        ("frames", f"{summary.frames}, {summary.frames / summary.fps:.0f} s"),
    ]
    for part in ("task", "brain"):
        if isinstance(chosen := summary.recording.get(part), Mapping):
            rows.append((part, str(chosen.get("type") or chosen.get("name") or "")))
    cameras = [key for key, feature in summary.features.items() if feature["dtype"] in ("video", "image")]
    rows.append(("cameras", ", ".join(f"`{key}`" for key in cameras) or "none"))
    shown = [_cell(task) for task in summary.tasks[:10]]
    more = f", and {len(summary.tasks) - 10} more" if len(summary.tasks) > 10 else ""
    rows.append(("instructions" if len(summary.tasks) > 1 else "instruction", "; ".join(shown) + more))
    rows.append(("size", f"{summary.size / 1e6:.1f} MB in {_some(summary.files, 'file')}"))
    return _table(("", ""), rows)


def _outcomes(facts: CardFacts) -> str:
    rows = [(name, str(count), f"{count / len(facts.summary.episodes):.0%}") for name, count in facts.outcomes.items()]
    said = f"\n\n{facts.success}" if facts.success else ""
    return _table(("outcome", "episodes", "share"), rows) + said


def _loading(facts: CardFacts) -> str:
    if facts.repo_id is None:
        return (
            f"```\nbhd-data pull {facts.url} --root=data/here\n```\n\n"
            "fetches it; then stock LeRobot loads it:\n\n```python\n"
            "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
            'dataset = LeRobotDataset("me/here", root="data/here")\n```'
        )
    return (
        "With LeRobot alone:\n\n```python\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        f'dataset = LeRobotDataset("{facts.repo_id}")\n```\n\n'
        f"Train on it:\n\n```\nlerobot-train --dataset.repo_id={facts.repo_id} --policy.type=act "
        "--policy.push_to_hub=false\n```\n\n"
        f"With bhd_lerobot, all of it or some episodes:\n\n```\nbhd-data pull {facts.repo_id} --root=data/here\n"
        f"bhd-data pull {facts.repo_id} --root=data/good --outcome=success\n"
        f"bhd-train --dataset.repo_id={facts.repo_id} --policy.type=bhd_mlp\n```"
    )


def _origin(facts: CardFacts) -> str:
    if not facts.identity:
        return ""
    text = json.dumps(facts.identity, indent=1, ensure_ascii=False)
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return (
        "## What made it\n\nRobot, task and brain with all their parameters, seed and video settings, from "
        f"`meta/bhd.json`:\n\n<details>\n<summary>configuration</summary>\n\n{fence}json\n{text}\n{fence}\n\n</details>"
    )


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *[[_cell(one) for one in row] for row in rows]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    """Return text that neither ends a cell nor starts a tag."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def _some(count: int, name: str) -> str:
    return f"{count} {name}{'' if count == 1 else 's'}"
