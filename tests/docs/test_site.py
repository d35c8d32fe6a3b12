"""The documentation site: it is built without a warning, loads nothing from elsewhere, and names all that is public."""

import re
from dataclasses import fields
from pathlib import Path
from pkgutil import resolve_name

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

import bhd_lerobot as bhd
from bhd_lerobot.evaluation.evaluate import EvalResult
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.rollout.replay.simulated import Divergence
from bhd_lerobot.training.rl.train import RlResult
from bhd_lerobot.training.train import TrainResult
from tests.docs.support import ROOT

REFERENCE = ROOT / "docs" / "reference" / "api.md"


@pytest.mark.thorough
def test_it_is_built_and_loads_nothing_from_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    monkeypatch.chdir(ROOT)
    build(load_config(str(ROOT / "mkdocs.yml"), strict=True, site_dir=str(tmp_path)))
    pages = sorted(tmp_path.rglob("*.html"))
    sources = sorted((ROOT / "docs").rglob("*.md"))
    assert {path.stem for path in sources if path.parent.name != "diagrams"} <= {path.stem for path in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=[\"']?(https?:[^\"' >]+)", text)
        assert loaded == [], page
    reference = (tmp_path / "reference" / "api.html").read_text(encoding="utf-8")
    for name in set(bhd.__all__) - {"__version__"}:
        assert re.search(rf'id="bhd_lerobot\.[\w.]*\b{name}"', reference), name


def test_the_reference_of_python_is_what_is_public() -> None:
    listed = re.findall(r"^::: [\w.]+\.(\w+)$", REFERENCE.read_text(encoding="utf-8"), re.MULTILINE)
    given = {"BaseTruth", "ArmTruth"}  # to methods that a user writes
    assert sorted(listed) == sorted(
        {*bhd.__all__, *given, *(path.rpartition(".")[2] for path in results())} - {"__version__"}
    )


def results() -> list[str]:
    """Return what is listed below the heading Results: what public functions return, by its full name."""
    section = re.search(r"^## Results\n(.*?)^## ", REFERENCE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert section is not None
    return re.findall(r"^::: ([\w.]+)$", section[1], re.MULTILINE)


def test_the_results_of_functions_are_documented_with_their_fields() -> None:
    found = {path: resolve_name(path) for path in results()}
    assert {RecordResult, TrainResult, RlResult, EvalResult, Divergence} <= set(found.values())
    lacking = [
        f"{path}.{one.name}"
        for path, made in found.items()
        for one in fields(made)
        if not re.search(rf"^ +(\w+, )*{one.name}(, \w+)*: ", made.__doc__ or "", re.MULTILINE)
    ]
    assert lacking == []
