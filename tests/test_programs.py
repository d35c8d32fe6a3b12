"""Programs of this package in processes of their own."""

from pathlib import Path

import pytest

from bhd_lerobot.programs import start_program


@pytest.mark.parametrize("where", ["sys.path", "PYTHONPATH"])
def test_a_program_finds_what_this_process_does_and_nothing_in_the_present_folder(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A person's own `random.py`, say, or one that another user has put into a folder of all."""
    folder = tmp_path / "plugins"
    folder.mkdir()
    (tmp_path / "random.py").write_text("raise SystemExit(1)\n")
    (folder / "my_plugin.py").write_text("import random, sys\nsys.exit(7 if random.random() < 1 else 2)\n")
    monkeypatch.chdir(tmp_path)
    if where == "sys.path":
        monkeypatch.syspath_prepend(folder)
    else:
        monkeypatch.setenv("PYTHONPATH", str(folder))
    assert start_program("my_plugin").wait() == 7
