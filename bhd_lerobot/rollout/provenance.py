"""What is stored with every episode, so that it can be understood and run again."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot import __version__
from bhd_lerobot.bodies.scenes import scene_from_json, scene_to_json, tuples
from bhd_lerobot.control.commands import BrainCommand, Pose
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.realtime.timing import TimingSummary
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Event, Outcome


def versions() -> dict[str, str]:
    """Return the versions of what decides an episode."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    # Read once: looking them up reads the distributions' metadata, which takes longer than saving an episode.
    return {"bhd_lerobot": __version__, **{name: metadata.version(name) for name in ("lerobot", "mujoco", "numpy")}}


def episode_metadata(episode: Episode, *, split: str, task: dict[str, Any], brain: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata columns of an episode: plain values, structures as JSON."""
    outcome = episode.outcome
    return {
        "episode": episode.spec.index,
        # As text: a 63-bit number does not survive a reader that takes numbers for floats.
        "seed": str(episode.spec.seed),
        "split": split,
        "success": outcome.success,
        "outcome": outcome.event.cause,
        "score": outcome.score,
        **outcome.details,
        "task": _json(task),
        "brain": _json(brain),
        "scene": scene_to_json(episode.scene),
        "initial_state": episode.initial_state.tolist(),
        "timing": _json(asdict(episode.timing)),
        "versions": _json(versions()),
        **({} if episode.realtime is None else {"realtime": _json(episode.realtime)}),
        **_goals(episode),
        **_interventions(episode),
    }


_OF_AN_EPISODE = frozenset(
    {
        *("episode", "seed", "split", "success", "outcome", "score", "task", "brain", "scene", "initial_state"),
        *("timing", "versions", "realtime", "plan", "goals", "results", "goal_frames"),
        *("intervened_frames", "interventions"),
    }
)
"""What `episode_metadata` writes besides the task's own details."""


def recorded_episode(recorded: Mapping[str, Any], columns: dict[str, NDArray], instruction: str) -> Episode:
    """Return a recorded episode from its metadata and columns: without images, goals and interventions."""
    try:
        details = {name: value for name, value in recorded.items() if name not in _OF_AN_EPISODE}
        event = Event[recorded["outcome"].upper()]
        return Episode(
            spec=EpisodeSpec(int(recorded["episode"]), int(recorded["seed"])),
            scene=scene_from_json(recorded["scene"]),
            instruction=instruction,
            initial_state=np.asarray(recorded["initial_state"], np.float64),
            columns=columns,
            outcome=Outcome(bool(recorded["success"]), event, float(recorded["score"]), details),
            timing=TimingSummary(**json.loads(recorded["timing"])),
            writer=None,
            plan=json.loads(recorded.get("plan") or "{}"),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"The recorded episode cannot be read: {error!r}.") from error


def _goals(episode: Episode) -> dict[str, Any]:
    """Return the plan, the goals and how they ended, of an episode that was driven by goals."""
    columns: dict[str, Any] = {}
    if episode.plan:
        columns["plan"] = _json(episode.plan)
    if episode.commands is not None:
        columns["goals"] = _json([[frame, asdict(command)] for frame, command in episode.commands])
        columns["results"] = _json(
            [[frame, end.task_id, end.success, end.code.name.lower(), end.message] for frame, end in episode.results]
        )
        if episode.goal_frames is not None:  # also of an episode that ended before the first goal
            columns["goal_frames"] = _json(episode.goal_frames)
    return columns


def _interventions(episode: Episode) -> dict[str, Any]:
    """Return the interventions of an episode, if the brain has any."""
    if episode.interventions is None:
        return {}
    return {
        "intervened_frames": sum(span.end - span.first for span in episode.interventions),
        "interventions": _json([[span.first, span.end, span.cause] for span in episode.interventions]),
    }


def command_from_json(fields: dict[str, Any]) -> BrainCommand:
    """Return the goal whose fields were recorded."""
    pose = fields["target_pose"]
    return BrainCommand(**{**tuples(fields), "target_pose": None if pose is None else Pose(**tuples(pose))})


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
