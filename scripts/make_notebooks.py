"""Write the tutorials of docs/tutorials as notebooks beside them, with jupytext.

python scripts/make_notebooks.py
"""

from pathlib import Path

import jupytext

TUTORIALS = Path(__file__).resolve().parents[1] / "docs" / "tutorials"


def notebook(tutorial: Path) -> str:
    """Return a tutorial as a notebook: a cell for each block of Python or bash, and text between them."""
    book = jupytext.reads(tutorial.read_text(encoding="utf-8"), fmt="md")
    # A link to another tutorial leads to its notebook; other pages are one folder further away.
    for number, cell in enumerate(book.cells):
        cell["id"] = f"cell-{number}"
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace("](../", "](../../")
    book.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return jupytext.writes(book, fmt="ipynb") + "\n"


def main() -> None:
    """Write every notebook."""
    folder = TUTORIALS / "notebooks"
    folder.mkdir(exist_ok=True)
    for tutorial in sorted(TUTORIALS.glob("*.md")):
        (folder / f"{tutorial.stem}.ipynb").write_text(notebook(tutorial), encoding="utf-8")


if __name__ == "__main__":
    main()
