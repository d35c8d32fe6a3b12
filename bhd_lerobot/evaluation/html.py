"""The pieces of HTML that a report is made of."""

from html import escape

from bhd_lerobot.evaluation.results import BrainSummary
from bhd_lerobot.evaluation.statistics import Estimate
from bhd_lerobot.evaluation.text import number


def share(count: int, one: BrainSummary) -> str:
    """Return a number of a brain's frames as a share of all of them."""
    return f"{count / one.frames:.2%}" if one.frames and count else "0"


def significant(estimate: Estimate) -> str:
    """Return a number with its interval, with digits that fit its size."""
    size = abs(estimate.value)
    return number(estimate, 0 if size >= 100 else 1 if size >= 10 else 2)


def cell(text: str, below: str = "") -> str:
    """Return a cell: a number, its interval below it, and something below that."""
    value, bracket, interval = text.partition(" (")
    lines = [value, f'<span class="ci">({interval}</span>' if bracket else "", f'<span class="ci">{below}</span>']
    return "<br>".join(line for line in lines if line and line != '<span class="ci"></span>')


def table(head: list[str], rows: list[tuple[str, list[str]]], baseline: str | None = None) -> str:
    """Return a table with a row for each brain; the baseline's is marked."""
    top = "".join(f"<th>{escape(one)}</th>" for one in ["brain", *head])
    body = "".join(
        f"<tr{' class=baseline' if label == baseline and len(rows) > 1 else ''}><td class='name'>{escape(label)}</td>"
        + "".join(f"<td>{one}</td>" for one in cells)
        + "</tr>"
        for label, cells in rows
    )
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def chart(source: str, text: str) -> str:
    """Return an image with words for those who do not see it."""
    return f'<img class="chart" src="{source}" alt="{escape(text)}">'
