"""The configurations that come with this package: `--config_path=ur5_pick` names one without its folder."""

from pathlib import Path

from bhd_lerobot.errors import ConfigError, unknown_name

_PACKAGE = Path(__file__).resolve().parents[1]
_FOLDER = _PACKAGE / "configs"
if not _FOLDER.is_dir():  # a checkout
    _FOLDER = _PACKAGE.parent / "configs"


def shipped_names(command: str) -> list[str]:
    """Return the names of the configurations of a command: `record`, `train` or `eval`."""
    return sorted(path.stem for path in (_FOLDER / command).glob("*.yaml"))


def found_config(path: Path, command: str) -> Path:
    """Return the file or folder that `--config_path` names: what lies there, or a configuration of this package."""
    if path.exists() or path.name != str(path) or path.suffix not in ("", ".yaml"):
        return path
    if path.stem in (names := shipped_names(command)):
        return _FOLDER / command / f"{path.stem}.yaml"
    if path.suffix:
        return path
    raise ConfigError(f"{unknown_name('configuration', path.name, names)} Or give --config_path a file.")
