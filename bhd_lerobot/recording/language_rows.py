"""What a brain with a plan did, as LeRobot's language rows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def language_column(plan: dict[str, Any], subtasks: NDArray, fps: int) -> NDArray:
    """Return LeRobot's column of what is said and stays valid: the plan, and every subtask from when it began.

    Every frame of an episode holds the same rows.

    Args:
        plan: the plan; its `steps` are pairs of a skill and a text.
        subtasks: what the brain was doing in each frame, shape (frames,).
        fps: frames a second [Hz].
    """
    rows: list[dict[str, Any]] = []

    def say(style: str, content: str, frame: int) -> None:
        when = {"timestamp": frame / fps, "camera": None, "tool_calls": None}
        rows.append({"role": "assistant", "content": content, "style": style, **when})

    if plan.get("steps"):
        say("plan", "\n".join(f"{number}. {text}" for number, (_, text) in enumerate(plan["steps"], 1)), 0)
    for frame, text in enumerate(subtasks):
        if frame == 0 or text != subtasks[frame - 1]:
            say("subtask", str(text), frame)
    column = np.empty(len(subtasks), dtype=object)
    column[:] = [rows] * len(subtasks)
    return column
