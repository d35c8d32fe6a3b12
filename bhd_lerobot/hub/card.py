"""The card of a dataset: `README.md` beside it, by which people and the Hub's viewer know what it is."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.state import DatasetState
from bhd_lerobot.datasets.format.summary import DatasetSummary, dataset_info
from bhd_lerobot.datasets.remote.listing import PREVIEW
from bhd_lerobot.datasets.remote.push import Card, sign
from bhd_lerobot.errors import counted
from bhd_lerobot.hub.preview import draw

LEROBOT_TAG = "LeRobot"
"""By this tag LeRobot's viewer finds datasets."""

_UNITS = ((".pos", "m or rad"), (".vel", "m/s or rad/s"))


@dataclass(frozen=True)
class CardOptions:
    """What a card has besides the content of the dataset; it lies at `url` if it is not on the Hub."""

    repo_id: str | None = None
    url: str = ""
    licence: str = "apache-2.0"
    tags: Sequence[str] = ()


def make_card(state: DatasetState, options: CardOptions, *, has_image: bool = False) -> Card:
    """Return the card of a dataset; always the same for the same dataset."""
    summary, identity = dataset_info(state.root), state.identity or {}
    drawn = (None, "An image of the dataset") if has_image else draw(summary, state)
    rows = [
        (f"`{key}`", str(feature["dtype"]), " x ".join(map(str, feature["shape"])), _meaning(key, feature))
        for key, feature in summary.features.items()
    ]
    parts = [
        _front_matter(summary, identity, options),
        f"# {(options.repo_id or options.url).rstrip('/').rpartition('/')[2]}",
        _introduction(summary, options),
        f"![{drawn[1]}]({PREVIEW})\n\n{drawn[1]}." if drawn else "",
        _overview(summary),
        _outcomes(summary),
        "## Columns\n\n" + _table(("key", "type", "shape", "meaning and unit"), rows),
        "## Loading it\n\n" + _loading(options),
        _origin(identity),
    ]
    return Card(sign("\n\n".join(part for part in parts if part) + "\n"), drawn[0] if drawn else None)


def _front_matter(summary: DatasetSummary, identity: Mapping[str, Any], options: CardOptions) -> str:
    task = summary.recording.get("task", {}).get("type")
    named = [name for name in ("bhd_lerobot" if identity else None, summary.robot_type, task) if name]
    tags = list(dict.fromkeys([LEROBOT_TAG, *named, *options.tags]))
    values = {
        "license": options.licence,
        "task_categories": ["robotics"],
        "tags": tags,
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    return f"---\n{yaml.safe_dump(values, sort_keys=False, allow_unicode=True)}---"


def _introduction(summary: DatasetSummary, options: CardOptions) -> str:
    from huggingface_hub import constants

    robot = f" of the robot `{summary.robot_type}`" if summary.robot_type else ""
    text = f"{counted(len(summary.episodes), 'episode')}{robot}, a LeRobotDataset of format v3.0."
    if options.repo_id:
        viewer = f"{constants.ENDPOINT}/spaces/lerobot/visualize_dataset?path={options.repo_id}"
        text += f" [View it in LeRobot's viewer]({viewer})."
    return text


def _overview(summary: DatasetSummary) -> str:
    rows = [
        ("robot", summary.robot_type or "unknown"),
        ("frames a second", str(summary.fps)),
        ("episodes", str(len(summary.episodes))),
        ("frames", f"{summary.frames}, {summary.frames / summary.fps:.0f} s"),
    ]
    for part in ("task", "brain"):
        if isinstance(chosen := summary.recording.get(part), Mapping):
            rows.append((part, str(chosen.get("type") or chosen.get("name") or "")))
    cameras = [key for key, feature in summary.features.items() if feature["dtype"] in ("video", "image")]
    rows.append(("cameras", ", ".join(f"`{key}`" for key in cameras) or "none"))
    shown = summary.tasks[:10]
    more = f", and {len(summary.tasks) - 10} more" if len(summary.tasks) > 10 else ""
    rows.append(("instructions" if len(summary.tasks) > 1 else "instruction", "; ".join(shown) + more))
    rows.append(("size", f"{summary.size / 1e6:.1f} MB in {counted(summary.files, 'file')}"))
    return _table(("", ""), rows)


def _outcomes(summary: DatasetSummary) -> str:
    counts = Counter(
        str(episode.metadata["outcome"]) for episode in summary.episodes if episode.metadata.get("outcome")
    )
    if not counts:
        return ""
    rows = [(name, str(count), f"{100 * count / len(summary.episodes):.0f} %") for name, count in counts.items()]
    return "\n\n".join(filter(None, ["## Outcomes", _table(("outcome", "episodes", "share"), rows), _success(summary)]))


def _success(summary: DatasetSummary) -> str:
    known = [
        bool(episode.metadata["success"]) for episode in summary.episodes if episode.metadata.get("success") is not None
    ]
    if not known:
        return ""
    from scipy.stats import binomtest

    low, high = binomtest(sum(known), len(known)).proportion_ci(method="wilson")
    return (
        f"{sum(known)} of {len(known)} episodes succeeded: {100 * sum(known) / len(known):.1f} %; 95 % interval of the "
        f"share (Wilson): {100 * low:.1f} to {100 * high:.1f} %."
    )


def _meaning(key: str, feature: dict[str, Any]) -> str:
    text = keys.meaning_of(key, feature)
    names = keys.names_of(feature)
    units = [f"`{suffix}` in {unit}" for suffix, unit in _UNITS if any(name.endswith(suffix) for name in names)]
    return text + (f" ({', '.join(units)})" if units else "")


def _loading(options: CardOptions) -> str:
    if options.repo_id is None:
        return (
            f"```\nbhd-data pull {options.url} --root=data/here\n```\n\n"
            "fetches it; then stock LeRobot loads it:\n\n```python\n"
            "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
            'dataset = LeRobotDataset("me/here", root="data/here")\n```'
        )
    return (
        "With LeRobot alone:\n\n```python\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        f'dataset = LeRobotDataset("{options.repo_id}")\n```\n\n'
        f"Train on it:\n\n```\nlerobot-train --dataset.repo_id={options.repo_id} --policy.type=act "
        "--policy.push_to_hub=false\n```\n\n"
        f"With bhd_lerobot, all of it or some episodes:\n\n```\nbhd-data pull {options.repo_id} --root=data/here\n"
        f"bhd-data pull {options.repo_id} --root=data/good --outcome=success\n"
        f"bhd-train --dataset.repo_id={options.repo_id} --policy.type=bhd_mlp\n```"
    )


def _origin(identity: Mapping[str, Any]) -> str:
    if not identity:
        return ""
    text = json.dumps(identity, indent=1, ensure_ascii=False)
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return (
        "## How it was recorded\n\nRobot, task and brain with all their parameters, seed and video settings, from "
        f"`meta/bhd.json`:\n\n<details>\n<summary>configuration</summary>\n\n{fence}json\n{text}\n{fence}\n\n</details>"
    )


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *[[_cell(cell) for cell in row] for row in rows]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    """Return text that neither ends a cell nor starts a tag."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
