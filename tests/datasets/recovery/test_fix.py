"""What follows from the rest can be repaired; the rest is never touched."""

import json
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.recovery.fix import fix, is_fixable
from bhd_lerobot.datasets.recovery.repair import repair
from bhd_lerobot.datasets.validate.dataset import Severity, check_dataset
from tests.datasets.edit_support import content, record
from tests.datasets.foreign import edit_json
from tests.datasets.support import snapshot

STATS, INFO = "meta/stats.json", "meta/info.json"


def stock(root: Path) -> Path:
    """Let a dataset look as if another program had recorded it."""
    (root / "meta/bhd.json").unlink()
    return root


def errors(root: Path) -> list[str]:
    return [str(finding) for finding in check_dataset(root).findings if finding.severity is Severity.ERROR]


DAMAGES = {
    "gone": lambda root: (root / STATS).unlink(),
    "no JSON": lambda root: (root / STATS).write_text("{"),
    "wrong mean": lambda root: edit_json(root / STATS, lambda s: s["observation.state"].update(mean=[9.0, 9.0, 9.0])),
    "a key is missing": lambda root: edit_json(root / STATS, lambda s: s.pop("observation.state")),
    "frames": lambda root: edit_json(root / INFO, lambda info: info.update(total_frames=3)),
}


@pytest.mark.parametrize("ours", [True, False])
def test_fix_restores_statistics_and_counts(tmp_path: Path, ours: bool) -> None:
    root = record(tmp_path / "d", [0, 1, 2], video=not ours)
    if not ours:
        stock(root)
    before, stats = content(root), json.loads((root / STATS).read_text())
    for name, damage_it in DAMAGES.items():
        damage_it(root)
        assert errors(root), name
        assert fix(root, check_dataset(root).findings), name
        assert errors(root) == []
        assert content(root) == before
        after = json.loads((root / STATS).read_text())
        assert after.keys() == stats.keys()
        for key, stat in stats.items():
            for statistic in ("min", "max", "mean", "std", "count"):
                # Videos are encoded, so statistics of their images may differ in the last bits.
                tolerance = 0.01 if "images" in key else 1e-6
                np.testing.assert_allclose(after[key][statistic], stat[statistic], rtol=0, atol=tolerance, err_msg=key)
        assert fix(root, check_dataset(root).findings) == []
        assert not (root / ".bhd").exists()


def test_nothing_is_fixed_while_there_is_another_error(tmp_path: Path) -> None:
    """Statistics of wrong data would hide what is wrong."""
    root = record(tmp_path / "d", [0, 1, 2])
    DAMAGES["wrong mean"](root)
    edit_json(root / INFO, lambda info: info["features"].pop("timestamp"))
    before = snapshot(root)
    found = check_dataset(root).findings
    assert any(is_fixable(one) for one in found)
    assert fix(root, found) == []
    assert snapshot(root) == before


@pytest.mark.parametrize("ours", [True, False])
def test_a_file_that_was_being_written_is_no_unfinished_recording(tmp_path: Path, ours: bool) -> None:
    """What version 0.2 left when `--fix` was killed, or met a full disk, while it wrote the count."""
    root = record(tmp_path / "d", [0, 1, 2])
    if not ours:
        stock(root)
    before, part = content(root), root / ".bhd/.info.json.part"
    DAMAGES["frames"](root)
    part.parent.mkdir()
    part.write_text('{"codebase_ver')
    (warning,) = [one for one in check_dataset(root).findings if one.where == ".bhd"]
    assert "before it changed anything" in warning.what
    assert fix(root, check_dataset(root).findings)
    assert errors(root) == []
    assert content(root) == before
    assert not part.parent.exists()
    for use in (lambda: mark(root, [1], outcome="failure"), lambda: repair(root)):
        part.parent.mkdir()
        part.write_text("{")
        use()
        assert not part.parent.exists()
