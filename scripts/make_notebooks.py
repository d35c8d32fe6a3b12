"""Write the tutorials of docs/tutorials as notebooks beside them, with jupytext.

python scripts/make_notebooks.py                  write the notebooks
python scripts/make_notebooks.py --run NAME ...   first run these tutorials, and write what their cells print below them

An output is a block of the language `output` below its code in the tutorial; in the notebook it is the cell's output.
"""

import contextlib
import io
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import jupytext
from nbformat.v4 import new_output

TUTORIALS = Path(__file__).resolve().parents[1] / "docs" / "tutorials"
_CELL = re.compile(r"^```(python|bash)\n(.*?)^```\n(?:\n```output\n.*?^```\n)?", re.MULTILINE | re.DOTALL)
_OUTPUT = re.compile(r"```output\n(.*?)```\s*", re.DOTALL)
# However few of a tutorial's cells are of Python: without it jupytext takes the language of most of them.
_PYTHON = "---\njupyter:\n  kernelspec:\n    name: python3\n    display_name: Python 3\n    language: python\n---\n\n"
# What differs from run to run, or between machines.
_PROGRESS = re.compile(r"real time|it/s\]|━ +\d")
_WHEN = re.compile(r"\d{4}-\d\d-\d\d/\d\d-\d\d-\d\d")
# Longer outputs keep so many lines at the beginning and at the end.
_FIRST, _LAST = 16, 4


def notebook(tutorial: Path) -> str:
    """Return a tutorial as a notebook: a cell for each block of Python or bash, its output, and text between them."""
    book = jupytext.reads(_PYTHON + tutorial.read_text(encoding="utf-8"), fmt="md")
    cells: list[Any] = []
    for cell in book.cells:
        if cells and cells[-1].cell_type == "code" and (found := _OUTPUT.match(cell.source)):
            cells[-1].outputs = [new_output("stream", name="stdout", text=found[1])]
            cell.source = cell.source[found.end() :]
        if cell.source:
            cells.append(cell)
    # A link to another tutorial leads to its notebook; other pages are one folder further away.
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace("](../", "](../../")
    book.cells = cells
    book.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return jupytext.writes(book, fmt="ipynb") + "\n"


def run(text: str) -> str:
    """Run a tutorial's cells in this process and in a new folder; return its text with what they print."""
    names = sys.modules.setdefault("tutorial", ModuleType("tutorial")).__dict__
    os.environ.update(COLUMNS="100", PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}")

    def cell(found: re.Match[str]) -> str:
        language, source = found.groups()
        block = f"```{language}\n{source}```\n"
        if language == "bash":
            printed = subprocess.check_output(["bash", "-e", "-c", source], stderr=subprocess.STDOUT, text=True)
        else:
            with contextlib.redirect_stdout(io.StringIO()) as stream:
                exec(compile(source, "<tutorial>", "exec"), names)
            printed = stream.getvalue()
        lines = [line.rstrip() for line in printed.splitlines() if not _PROGRESS.search(line)]
        if len(lines) > _FIRST + _LAST + 1:
            lines[_FIRST:-_LAST] = [f"… {len(lines) - _FIRST - _LAST} lines …"]
        return block + "\n```output\n" + "\n".join(lines) + "\n```\n" if lines else block

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        return _WHEN.sub("YYYY-MM-DD/hh-mm-ss", _CELL.sub(cell, text).replace(f"{folder}/", ""))


def main(arguments: list[str]) -> None:
    """Run the tutorials that are named behind `--run`, and write every notebook."""
    for name in arguments[1:] if arguments[:1] == ["--run"] else ():
        tutorial = TUTORIALS / f"{name}.md"
        tutorial.write_text(run(tutorial.read_text(encoding="utf-8")), encoding="utf-8")
    folder = TUTORIALS / "notebooks"
    folder.mkdir(exist_ok=True)
    for tutorial in sorted(TUTORIALS.glob("*.md")):
        (folder / f"{tutorial.stem}.ipynb").write_text(notebook(tutorial), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
