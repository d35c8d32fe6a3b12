"""A notebook's cells, run in a process that has imported everything: Jupyter's kernel would import it again."""

import json
import os
import shlex
import sys
import traceback
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any


def run(notebook: Path, folder: Path, shorter: dict[str, str]) -> int:
    """Run every cell in a folder, as Jupyter would; return 1 if one fails.

    Args:
        notebook: the file.
        folder: where it runs.
        shorter: what is replaced in its cells so that it takes less time; each has to occur.
    """
    left = dict(shorter)
    os.chdir(folder)
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    names: dict[str, Any] = {"__name__": "__main__"}
    sys.modules["__main__"].__dict__.update(names)
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        for long, short in shorter.items():
            if long in source:
                source = source.replace(long, short)
                left.pop(long, None)
        if cell["cell_type"] != "code":
            continue
        try:
            if source.startswith("%%bash"):
                for line in source.removeprefix("%%bash\n").replace("\\\n", " ").splitlines():
                    _command(shlex.split(line))
            else:
                exec(compile(source, str(notebook), "exec"), sys.modules["__main__"].__dict__)
        except BaseException:
            traceback.print_exc()
            return 1
        finally:
            sys.stdout.flush()
    print(*(f"{long} is in no cell" for long in left))
    return len(left)


def _command(arguments: list[str]) -> None:
    """Run one of the package's commands in a fork of this process."""
    (entry,) = entry_points(group="console_scripts", name=arguments[0])
    child = os.fork()
    if child == 0:
        sys.argv = arguments
        status: Any = 1
        try:
            status = entry.load()()
        except SystemExit as end:
            status = end.code
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status if isinstance(status, int) else int(status is not None))
    _, waited = os.waitpid(child, 0)
    if os.waitstatus_to_exitcode(waited) != 0:
        raise RuntimeError(f"{shlex.join(arguments)} ended with {os.waitstatus_to_exitcode(waited)}")
