"""What an option may be, declared in its type: ``hold_s: Positive = 1.0``. Check, help and reference read it there.

It imports nothing that takes time: every package may declare options.
"""

import dataclasses
import functools
import math
import re
import typing
from collections.abc import Callable, Iterable
from numbers import Integral, Real
from typing import Annotated, Any, ClassVar

from bhd_lerobot.errors import ConfigError, unknown_name


class Range:
    """The numbers of an interval: ``"[0, 1)"`` is from 0 to below 1, ``"(0, inf)"`` positive and finite."""

    def __init__(self, interval: str) -> None:
        found = re.fullmatch(r"([\[(])(\S+), (\S+)([\])])", interval)
        assert found, interval
        self.low, self.high = float(found[2]), float(found[3])
        self._above, self._below = found[1] == "(", found[4] == ")"

    def __str__(self) -> str:
        low, high = (f"{one:.0f}" if one.is_integer() else f"{one:.6g}" for one in (self.low, self.high))
        if self.low == -math.inf:
            return "finite"
        if self.high == math.inf:
            above = "positive" if self._above and not self.low else f"{'above' if self._above else 'at least'} {low}"
            return f"{above} and finite" if self._below else above
        if self._above and self._below:
            return f"between {low} and {high}"
        if self._above:
            return f"above {low} and at most {high}"
        return f"from {low} to {'below ' if self._below else ''}{high}"

    def check(self, key: str, value: Any, kind: type) -> None:
        """Refuse what is not a number of this interval; a list is left to its entries' own declaration."""
        if isinstance(value, list | tuple):
            return
        is_kind = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        too_low = is_kind and not (value > self.low if self._above else value >= self.low)
        if not is_kind or too_low or not (value < self.high if self._below else value <= self.high):
            number = "" if is_kind else f"a {'whole ' * (kind is int)}number, "
            no_limit = ", or .inf for no limit" if kind is float and self.high == math.inf and not self._below else ""
            raise ConfigError(f"{key} is {value!r}; it must be {number}{self}{no_limit}.")


class OneOf:
    """Some texts, by name."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)

    def __str__(self) -> str:
        return f"one of {', '.join(self.names)}"

    def check(self, key: str, value: Any, kind: type) -> None:
        """Refuse what is none of them, with the nearest."""
        if value not in self.names:
            raise ConfigError(unknown_name(key, value, self.names))


Positive = Annotated[float, Range("(0, inf)")]
NotNegative = Annotated[float, Range("[0, inf)")]
Finite = Annotated[float, Range("(-inf, inf)")]
Share = Annotated[float, Range("[0, 1]")]
Count = Annotated[int, Range("[1, inf]")]
Whole = Annotated[int, Range("[0, inf]")]
LibrarySeed = Annotated[int, Range("[0, 4294967295]")]
"""A seed that NumPy's global generator takes, too, as it is in LeRobot and Stable-Baselines3."""


class Options:
    """Base of configurations: each field is what its type declares, or the configuration is refused by name.

    A class of options names what stands before them in messages: ``class X(Options, prefix="brain.")``. One with a
    `__post_init__` of its own calls `check_options`, or that of this class.
    """

    option_prefix: ClassVar[str] = ""

    def __init_subclass__(cls, prefix: str | None = None, **others: Any) -> None:
        super().__init_subclass__(**others)
        if prefix is not None:
            cls.option_prefix = prefix

    def __post_init__(self) -> None:
        check_options(self)


def check_options(config: Any, prefix: str | None = None) -> None:
    """Check the fields of a dataclass."""
    before = getattr(config, "option_prefix", "") if prefix is None else prefix
    for name, kind in declared_types(config.__class__).items():
        check_option(f"{before}{name}", getattr(config, name), kind)


@functools.cache
def declared_types(config_class: Any) -> dict[str, Any]:
    """Return the types of a dataclass's fields, with what they declare."""
    hints = typing.get_type_hints(config_class, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(config_class)}


def check_option(key: str, value: Any, kind: Any) -> None:
    """Refuse the value of an option that its type does not allow; the entries of lists and mappings, too."""
    if value is None:
        return
    for one in _declared(kind):
        one.check(key, value, kind.__origin__)
    origin, inner = typing.get_origin(kind), [one for one in typing.get_args(kind) if one is not ...]
    if origin in (list, tuple) and isinstance(value, list | tuple):
        for at, entry in enumerate(value):
            check_option(f"{key}[{at}]", entry, inner[min(at, len(inner) - 1)])
    elif origin is dict and isinstance(value, dict):
        for name, entry in value.items():
            check_option(f"{key}.{name}", entry, inner[1])
    elif type(None) in inner:
        for one in inner:
            try:
                check_option(key, value, one)
            except ConfigError as error:
                raise ConfigError(f"{str(error).removesuffix('.')}; null is valid, too.") from None


def declaration_of(config_class: type, name: str) -> str:
    """Return what a field may be, in words; empty if its type says all."""
    kinds = [declared_types(config_class)[name]]
    while kinds:
        kind = kinds.pop()
        if given := _declared(kind):
            return str(given[0])
        kinds += [one for one in typing.get_args(kind) if not isinstance(one, str)]
    return ""


def _declared(kind: Any) -> list[Range | OneOf]:
    """Return what a type declares; what a plug-in annotates it with for others is not ours."""
    return [one for one in getattr(kind, "__metadata__", ()) if isinstance(one, Range | OneOf)]


def some_of(base: Any, is_one: Callable[[Any], bool]) -> Any:
    """Return a choice type with those choices of another that fulfil a condition.

    LeRobot's command lines list the options of every choice, and those of the choices in them: what may hold itself
    they list without an end.
    """
    import draccus

    class Some(draccus.ChoiceRegistry):
        lerobot_package = base.__module__

        @classmethod
        def get_known_choices(cls) -> dict[str, Any]:
            """Return the choices by their names."""
            return {name: choice for name, choice in base.get_known_choices().items() if is_one(choice)}

        @classmethod
        def get_choice_class(cls, name: str) -> Any:
            """Return the choice of a name."""
            return cls.get_known_choices()[name]

        @classmethod
        def get_choice_name(cls, subcls: type) -> str:
            """Return the name of a choice."""
            return str(base.get_choice_name(subcls))

    return Some
