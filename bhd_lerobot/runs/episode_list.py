"""Episodes as a user names them: `0,3,5-9`."""

import re
from collections.abc import Sequence

from bhd_lerobot.errors import ConfigError


def parse_episodes(text: str) -> list[int]:
    """Return the numbers in `text`: single ones and ranges, separated by commas, brackets around them or not.

    Raises:
        ConfigError: something else is in it, or a range runs backwards.
    """
    numbers: list[int] = []
    for part in re.split(r"[,\s]+", text.strip().removeprefix("[").removesuffix("]").strip()):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if match is None:
            raise ConfigError(f"{part!r} in {text!r} names no episode. Valid: numbers and ranges, such as 0,3,5-9.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"The range {part!r} in {text!r} runs backwards; write {last}-{first}.")
        numbers += range(first, last + 1)
    return numbers


def short(episodes: Sequence[int]) -> str:
    """Return numbers the way `parse_episodes` reads them."""
    parts: list[list[int]] = []
    for episode in episodes:
        if parts and episode == parts[-1][1] + 1:
            parts[-1][1] = episode
        else:
            parts.append([episode, episode])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)
