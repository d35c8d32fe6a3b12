"""What options declare in their types is what is accepted of them, whoever makes the configuration."""

import dataclasses
import math
import typing
from collections.abc import Iterator
from typing import Annotated, Any

import pytest

from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.environment import EnvironmentEvalConfig
from bhd_lerobot.options.declared import OneOf, Options, Range, check_option, declaration_of, declared_types
from bhd_lerobot.options.parse import choices_of, decode, entries_of, options_of
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.ros2.serve.config import BridgeConfig, ServeConfig
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.dagger.config import AggregationConfig
from bhd_lerobot.training.rl.config import RlConfig
from tests.cases import each_case

PROGRAMS = (RecordConfig, ReplayConfig, EvalConfig, EnvironmentEvalConfig, BhdTrainConfig, RlConfig, AggregationConfig)


def classes() -> list[Any]:
    """Return every class of options of this package that a program has."""
    found: dict[Any, None] = {}
    rest: list[Any] = [*PROGRAMS, ServeConfig, BridgeConfig, LoaderConfig]
    while rest:
        kind = rest.pop()
        if kind in found or not kind.__module__.startswith("bhd_lerobot."):
            continue
        found[kind] = None
        for _, hint, _ in options_of(kind):
            rest += choices_of(entries_of(hint) or hint).values()
            rest += [one for one in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(one)]
    return list(found)


def wrong(kind: Any) -> Iterator[tuple[Any, str]]:
    """Yield values that a type does not allow, and what follows the option's name in the message."""
    for one in getattr(kind, "__metadata__", ()):
        if isinstance(one, OneOf):
            yield "nobody", " 'nobody'"
        else:
            step = 1 if kind.__origin__ is int else 1e-9
            values = (one.low - step, one.high + step, math.nan, "x")
            yield from ((value, f" is {value!r}") for value in values if value != math.inf or "finite" in str(one))
    for inner in typing.get_args(kind):
        if typing.get_origin(kind) in (list, tuple):
            yield from (([value], f"[0]{message}") for value, message in wrong(inner))
        elif type(None) in typing.get_args(kind):
            yield from wrong(inner)


@pytest.mark.law
@each_case("kind", classes())
def test_what_is_not_declared_is_refused_by_name_of_a_file_and_of_python(kind: Any) -> None:
    for name, hint in declared_types(kind).items():
        for value, message in wrong(hint):
            for make in (lambda: decode(kind, {name: value}), lambda: check_option(name, value, hint)):  # noqa: B023
                with pytest.raises(ConfigError) as caught:
                    make()
                assert f"{name}{message}" in str(caught.value)
            if issubclass(kind, Options) and dataclasses.MISSING not in [one[2] for one in options_of(kind)]:
                with pytest.raises(ConfigError, match=rf"\b{kind.option_prefix}{name}\b"):
                    kind(**{name: value})


def test_what_a_plug_in_annotates_for_others_declares_nothing() -> None:
    @dataclasses.dataclass
    class Own(Options, prefix="brain."):
        speed: Annotated[float, "rad/s"] = 0.5
        share: Annotated[float, "of all", Range("[0, 1]")] = 0.5

    assert Own(speed=7.0).speed == 7.0
    assert (declaration_of(Own, "speed"), declaration_of(Own, "share")) == ("", "from 0 to 1")
    with pytest.raises(ConfigError, match=r"brain.share is 2"):
        Own(share=2)


def test_defaults_are_what_is_declared() -> None:
    for kind in classes():
        for name, _, default in options_of(kind):
            if default is not dataclasses.MISSING:
                check_option(name, default, declared_types(kind)[name])


@each_case(
    ("interval", "words", "inside", "outside"),
    [
        ("(0, inf)", "positive and finite", (1e-9, 7), (0, -1, math.inf, math.nan, True, "1")),
        ("[0, inf)", "at least 0 and finite", (0, 1), (-1e-9, math.inf)),
        ("[1, inf]", "at least 1, or .inf for no limit", (1, math.inf), (0, math.nan)),
        ("(-inf, inf)", "finite", (-1e300, 0), (math.inf, -math.inf, math.nan)),
        ("(0, 180]", "above 0 and at most 180", (0.1, 180), (0, 180.1)),
        ("[0, 1)", "from 0 to below 1", (0, 0.9), (1, -0.1)),
        ("(0, 1)", "between 0 and 1", (0.5,), (0, 1)),
        ("[-2, 2]", "from -2 to 2", (-2, 2), (-2.1, 2.1)),
    ],
)
def test_a_range_is_its_interval(interval: str, words: str, inside: tuple[Any, ...], outside: tuple[Any, ...]) -> None:
    hint = Annotated[float, Range(interval)]
    for value in inside:
        check_option("a.b", value, hint)
    for value in outside:
        with pytest.raises(ConfigError, match=rf"^a\.b is {value!r}; it must be .*{words}\.$"):
            check_option("a.b", value, hint)
    with pytest.raises(ConfigError, match="null is valid, too"):
        check_option("a.b", outside[0], hint | None)
