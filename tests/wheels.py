"""Wheels of this checkout and of its examples, installed into environments of their own."""

import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from hatchling import build


def wheel_of(project: Path, folder: Path) -> zipfile.ZipFile:
    """Build the wheel of a project into a folder, and open it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project)
        return zipfile.ZipFile(folder / build.build_wheel(str(folder)))


def install(project: Path, folder: Path) -> Path:
    """Build the wheel of a project, and install it into a new virtual environment.

    The environment has whatever packages this one has, but reads what the wheel holds from the wheel.
    """
    environment = folder / "environment"
    venv.create(environment, symlinks=True)
    base = {"base": str(environment), "platbase": str(environment)}
    site = Path(sysconfig.get_path("purelib", "posix_prefix", vars=base))
    (site / "parent.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    with wheel_of(project, folder) as wheel:
        wheel.extractall(site)
    return environment / "bin" / "python"
