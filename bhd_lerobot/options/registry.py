"""What can be chosen by name: one table of each kind, for this package and for others alike."""

import pkgutil
from collections.abc import Iterator, Mapping
from typing import Any

from bhd_lerobot.errors import ConfigError


class Registry[T](Mapping[str, T]):
    """What can be chosen by name, of one kind.

    Args:
        word: what one of them is called in messages.
        own: those of this package; a text, ``"module:Name"``, for what takes long to import.
        choices: draccus's registry of their configurations, if they have any.
    """

    def __init__(self, word: str, own: Mapping[str, T | str], choices: Any = None) -> None:
        self._word, self._table, self._choices = word, dict(own), choices

    def __getitem__(self, name: str) -> T:
        value: Any = self._table[name]
        return pkgutil.resolve_name(value) if isinstance(value, str) else value

    def __contains__(self, name: object) -> bool:
        return name in self._table

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)

    def register(self, name: str, value: T | str, config: type | None = None) -> None:
        """Add one, with its configuration; the same one again changes nothing, another one is refused."""
        known: Any = self._table.get(name) if config is None else self._choices.get_known_choices().get(name)
        added = value if config is None else config
        if known is not None and known != added:
            raise ConfigError(
                f"There is {with_article(self._word)} {name!r} already, of {_origin(known)}; that of {_origin(added)} "
                "needs another name."
            )
        if config is not None and known is None:
            self._choices.register_subclass(name)(config)
        self._table[name] = value

    def of(self, config: Any) -> T:
        """Return what a configuration is of."""
        name = config.get_choice_name(type(config))
        if name not in self._table:
            raise ConfigError(
                f"The {self._word} {name!r} has a configuration, {type(config).__module__}."
                f"{type(config).__qualname__}, and no class: register that with bhd_lerobot.register_{self._word}."
            )
        return self[name]


def with_article(word: str) -> str:
    """Return a noun with its article."""
    return f"{'an' if word[:1] in 'aeiou' else 'a'} {word}"


def _origin(value: Any) -> str:
    return " and ".join(value) if isinstance(value, tuple) else str(getattr(value, "__module__", value))
