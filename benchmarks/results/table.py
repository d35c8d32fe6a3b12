"""The table of sections, `sections.yaml`, with its words and its repetitions written out."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml


class Table:
    """What is measured, and how it is shown.

    Attributes:
        sections: by their names, as the file has them.
        seeds: of the trainings.

    Args:
        out: the folder that the commands write to.
    """

    def __init__(self, out: Path) -> None:
        table = yaml.safe_load(Path(__file__).with_name("sections.yaml").read_text(encoding="utf-8"))
        self.sections: dict[str, dict[str, Any]] = table["sections"]
        self.seeds: list[int] = table["seeds"]
        self._words = {**table["words"], "out": out}

    def expand(self, entries: Sequence[Any], **words: Any) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Yield the entries of a list, repeated and filled, each with the words that it was filled with."""
        for entry in entries:
            if isinstance(entry, Mapping) and "for" in entry:
                each = [{"seed": seed} for seed in self.seeds] if entry["for"] == "seeds" else entry["for"]
                for more in each:
                    yield from self.expand(entry["do"], **words, **more)
            else:
                yield self.fill(entry, **words), words

    def fill(self, entry: Any, **words: Any) -> Any:
        """Replace the words in braces, in words as well; those that are not known stay."""
        if isinstance(entry, Mapping):
            return {key: self.fill(value, **words) for key, value in entry.items()}
        if isinstance(entry, list):
            return [self.fill(value, **words) for value in entry]
        if not isinstance(entry, str):
            return entry
        filled = entry.format_map(_Known({**self._words, **words}))
        return filled if filled == entry else self.fill(filled, **words)

    def commands(self, part: Mapping[str, Any], **words: Any) -> list[str]:
        """Return the command lines of a part of a section."""
        return [command for command, _ in self.expand(part["commands"], **words)]


class _Known(dict[str, Any]):
    def __missing__(self, key: str) -> str:
        return f"{{{key}}}"
