"""The tutorials run as they stand: each notebook is its tutorial, and every cell of it works."""

from pathlib import Path

import pytest

from tests.docs.run_notebook import run
from tests.docs.support import ROOT, load_script
from tests.forks import Fork

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
# Something that the output has to contain, because it is what the tutorial is about.
SHOWN = {
    "record_and_look": ["400 frames in 4 episodes", "valid, no errors", "identical in 100 frames"],
    "train_and_evaluate": ["8 of 8 episodes succeeded", "step  300", "difference: "],
    "from_a_ros2_bag": ["control.applied_action", "valid, no errors"],
    "your_own": ["4 of 4 episodes succeeded", "gap_follower 4 of 4"],
}


def test_every_tutorial_is_known_and_its_notebook_is_up_to_date() -> None:
    script = load_script("make_notebooks")
    assert {path.stem for path in TUTORIALS} == set(SHOWN)
    for path in TUTORIALS:
        written = path.parent / "notebooks" / f"{path.stem}.ipynb"
        assert written.read_text(encoding="utf-8") == script.notebook(path), "run: python scripts/make_notebooks.py"


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_it_runs(tutorial: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    status = Fork(run, tutorial.parent / "notebooks" / f"{tutorial.stem}.ipynb", folder, output=tmp_path / "out").wait()
    printed = (tmp_path / "out").read_text(encoding="utf-8")
    assert status == 0, printed
    for text in SHOWN[tutorial.stem]:
        assert text in printed, printed
