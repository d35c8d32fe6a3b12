"""The folder of a run: its configuration, results and images."""

import contextlib
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import RUN_CONFIG, encode


@contextlib.contextmanager
def run_folder(config: Any, kind: str, name: str = "") -> Iterator[Path]:
    """Make the folder of a run, with its resolved configuration; if the block fails, the run was refused.

    A run that was refused leaves no folder; what was there before stays. The default place is a new folder in
    ``outputs/<kind>``, by default with a name of robot and task.
    """
    if config.output_dir:
        folder = Path(config.output_dir).expanduser()
    else:
        now = datetime.now()
        name = name or f"{config.robot.type}_{config.task.get_choice_name(type(config.task))}"
        folder = Path("outputs") / kind / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{name}"
    try:
        folder, missing = made(folder, is_new=not config.output_dir)
        before = (folder / RUN_CONFIG).read_bytes() if (folder / RUN_CONFIG).is_file() else None
        (folder / RUN_CONFIG).write_text(yaml.safe_dump(encode(config), sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error
    try:
        yield folder
    except BaseException:
        with contextlib.suppress(OSError):
            if before is None:
                (folder / RUN_CONFIG).unlink()
            else:
                (folder / RUN_CONFIG).write_bytes(before)
            for path in missing:
                path.rmdir()
        raise


def made(folder: Path, *, is_new: bool) -> tuple[Path, list[Path]]:
    """Make a folder, or one beside it if it is to be new; return it, and what of its path was not there."""
    place, number = folder, 1
    while True:
        missing = [path for path in (place, *place.parents) if not path.exists()]
        try:
            place.mkdir(parents=True, exist_ok=not is_new)
        except FileExistsError:
            if not is_new:
                raise
            number += 1  # another run began in the same second, or the clock was put back
            place = folder.with_name(f"{folder.name}_{number}")
        else:
            return place, missing
