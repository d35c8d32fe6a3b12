"""Episodes as a user names them: `0,3,5-9`."""

import re
from collections import Counter
from collections.abc import Sequence

from bhd_lerobot.errors import ConfigError

_MOST = 1_000_000  # numbers in a range: a slip of the finger shall not fill the memory


def parse_episodes(text: str) -> list[int]:
    """Return the numbers in `text`: single ones and ranges, separated by commas, brackets around them or not."""
    numbers: list[int] = []
    for part in re.split(r"[,\s]+", text.strip().removeprefix("[").removesuffix("]").strip()):
        match = re.fullmatch(r"([0-9]{1,12})(?:-([0-9]{1,12}))?", part)
        if match is None:
            raise ConfigError(f"{part!r} in {text!r} names no episode. Valid: numbers and ranges, such as 0,3,5-9.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"The range {part!r} in {text!r} runs backwards; write {last}-{first}.")
        if last - first >= _MOST:
            raise ConfigError(f"The range {part!r} in {text!r} names {last - first + 1} episodes; at most {_MOST}.")
        numbers += range(first, last + 1)
    if len(set(numbers)) != len(numbers):
        twice = next(number for number, count in Counter(numbers).items() if count > 1)
        raise ConfigError(f"Episode {twice} is named twice in {text!r}.")
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
