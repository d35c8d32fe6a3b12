"""Tests of one law with many examples."""

import functools
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest


def each_case(names: str | tuple[str, ...], examples: Iterable[Any]) -> Callable[[Callable[..., None]], Any]:
    """Run a test with every example, as one test; its report holds every example that failed.

    For examples of milliseconds that share their fixtures. Examples that take seconds, or that need fixtures of their
    own, belong in ``pytest.mark.parametrize``, which makes a test of each.

    Args:
        names: the arguments of the test that an example gives, as in ``pytest.mark.parametrize``.
        examples: a value for each name, or the value for the only name; or a ``pytest.param`` of them.

    Returns:
        A decorator. A test that takes ``tmp_path`` gets an empty folder for each example.
    """
    listed = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    cases = []
    for example in examples:
        if isinstance(example, type(pytest.param())):
            values = example.values
        else:
            values = (example,) if len(listed) == 1 and isinstance(names, str) else example
        cases.append(dict(zip(listed, values, strict=True)))

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(test)

        @functools.wraps(test)
        def run_all(**fixtures: Any) -> None:
            assert cases, "no examples"
            errors: list[BaseException] = []
            folder: Path | None = fixtures.get("tmp_path")
            for number, case in enumerate(cases):
                if folder is not None:
                    fixtures["tmp_path"] = folder / f"case_{number}"
                    fixtures["tmp_path"].mkdir()
                try:
                    test(**fixtures, **case)
                except (Exception, SystemExit, BaseExceptionGroup, pytest.fail.Exception) as error:
                    error.add_note(f"example {number}: {case!r:.1000}")
                    errors.append(error)
            if len(errors) == 1:
                raise errors[0]
            if errors:
                raise BaseExceptionGroup(f"{len(errors)} of {len(cases)} examples failed", errors)

        left = [one for name, one in signature.parameters.items() if name not in listed]
        run_all.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        return run_all

    return decorate
