"""What costs the tests time and changes nothing that they look at.

Only in the process of the tests, and in what is forked from it: programs that a test starts in an interpreter of their
own are as a user has them.
"""

import functools
import os
import sys
from pathlib import Path
from typing import Any


def install() -> None:
    """Let libraries that are imported do each thing once that they do for each column and for each option.

    Nothing is flushed to the device: no test cuts the power, and each time costs milliseconds.
    """
    os.fsync = lambda fd: None
    features = sys.modules.get("datasets.features.features")
    if features is not None:
        # Each of some 270 columns of a dataset's episodes that is set computes this of all columns again.
        def set_feature(self: Any, name: str, feature: Any) -> None:
            dict.__setitem__(self, name, feature)
            self._column_requires_decoding[name] = features.require_decoding(feature)

        features.Features.__setitem__ = set_feature
    docstring = sys.modules.get("draccus.wrappers.docstring")
    if docstring is not None and not hasattr(docstring.get_attribute_docstring, "cache_info"):
        # The text of a class is read for the help of each of its options, by every command line that is parsed.
        docstring.get_attribute_docstring = functools.cache(docstring.get_attribute_docstring)


def draw(is_drawn: bool) -> None:
    """Let charts be drawn, a third of a second each; or be empty files, so that a test which looks at one fails."""
    module = sys.modules.get("matplotlib.figure")
    if module is None:
        return
    for name, stand_in in _STAND_INS.items():
        original = _ORIGINALS.setdefault(name, getattr(module.Figure, name))
        setattr(module.Figure, name, original if is_drawn else stand_in)


class _Blank:
    """Takes whatever is done with axes."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *_: Any, **__: Any) -> Any:
        return self

    def __getitem__(self, _: Any) -> Any:
        return self

    def __iter__(self) -> Any:
        return iter(())

    def add_patch(self, patch: Any) -> Any:
        return patch

    def get_xlim(self) -> tuple[float, float]:
        return 0.0, 1.0

    get_ylim = get_xlim


_BLANK = _Blank()


def _subplots(_figure: Any, nrows: int = 1, ncols: int = 1, *, squeeze: bool = True, **_: Any) -> Any:
    import numpy as np  # not before its number of threads is set

    grid = np.full((nrows, ncols), _BLANK, object)
    if not squeeze:
        return grid
    return _BLANK if grid.size == 1 else grid.squeeze()


def _nothing(*_: Any, **__: Any) -> Any:
    return _BLANK


def _save(_figure: Any, file: Any, **_: Any) -> None:
    if not hasattr(file, "write"):
        Path(file).write_bytes(b"")


_STAND_INS = {"subplots": _subplots, "savefig": _save} | dict.fromkeys(
    ("suptitle", "supxlabel", "supylabel", "subplots_adjust"), _nothing
)
_ORIGINALS: dict[str, Any] = {}
