"""Every error of this package, in one tree.

A message names the offending value, what would have been valid, and what to do about it. Command-line programs print
the message of a `BhdError` without a traceback and exit with status 2; any other exception is a bug and keeps its
traceback.
"""

import difflib
import shlex
from collections.abc import Iterable


class BhdError(Exception):
    """Base class of everything this package raises on purpose; `exit_status`: that of a program which it ends."""

    exit_status = 2


class ConfigError(BhdError, ValueError):
    """A configuration value that cannot be honoured."""


class VersionError(BhdError):
    """A package that this one needs is missing, or installed in a version that this one does not support."""


class ActionError(BhdError, ValueError):
    """An action with the wrong keys, the wrong order, the wrong type or a non-finite value."""


class InstructionError(BhdError, ValueError):
    """An instruction that is not understood or fits no single object, or a plan that cannot be carried out."""


class NothingFitsError(InstructionError):
    """An instruction that is understood, about something that is not there."""


class PerceptionError(BhdError):
    """A camera shows nothing that can be used, or what it shows is too uncertain to act on."""


class CommandRefusedError(BhdError):
    """The cerebellum, or a server of a ROS 2 action, refused a well-formed command."""


class SimulationError(BhdError):
    """The physics diverged, or a simulation was used in a way that it cannot serve."""


class BrainStoppedError(BhdError):
    """A brain has no action any more, and never will: the episode ends with a fault."""


class RealtimeError(BhdError):
    """The real-time process cannot be started as asked, has ended, or does not answer."""


class PlantLostError(RealtimeError):
    """What drives a robot has ended, and does not come back before the plant is opened again."""


class RenderingError(BhdError):
    """No image can be rendered on this machine; the message names the remedy."""


class ClusterError(BhdError):
    """The cluster cannot be reached or gives no machine, or its machines would not record the same bytes."""


class DatasetError(BhdError):
    """Base class of everything that can be wrong with a dataset on disk."""


class DatasetExistsError(DatasetError):
    """The dataset root exists and the caller did not ask to resume."""


class DatasetMismatchError(DatasetError):
    """A dataset that was to be resumed was recorded with another robot, frame rate or feature set."""


class DatasetCorruptError(DatasetError):
    """A file of the dataset cannot be read."""


class DatasetWriteError(DatasetError):
    """An episode could not be written: full disk, missing permission, file-size limit."""


class DatasetLockedError(DatasetError):
    """Another process is writing this dataset."""


class MemoryBudgetError(DatasetError):
    """The frames of a dataset do not fit the memory that they may take, or that is free."""


class UnsupportedDatasetError(DatasetError):
    """LeRobot's own loader is needed: a kind of feature that is not kept in memory."""


class TransferError(BhdError):
    """An upload or download that did not come to its end: no permission, no network, no such place."""


class FrameError(DatasetError, ValueError):
    """A frame, an image or episode metadata that does not fit the features of the dataset."""


def as_text(error: BaseException) -> str:
    """Return an error as text without a full stop at the end: its message, with its kind if it is not one of ours."""
    kind = "" if isinstance(error, BhdError) else f"{type(error).__name__}: "
    return " ".join(f"{kind}{error}".split()).removesuffix(".")


def unknown_name(kind: str, value: object, choices: Iterable[str], meant: str = "") -> str:
    """Return the message for a name that is not among the valid ones, with the nearest valid name if there is one.

    Args:
        kind: what the name stands for, for example ``"brain"``.
        value: the name that was given.
        choices: the valid names.
        meant: what it stands for, where that is known; by default the nearest valid name.
    """
    names = sorted(choices)
    by_lower_case = {name.lower(): name for name in names}
    near = difflib.get_close_matches(str(value).lower(), by_lower_case, n=1, cutoff=0.6)
    meant = meant or (by_lower_case[near[0]] if near else "")
    hint = f" Did you mean {meant!r}?" if meant else ""
    return f"Unknown {kind} {value!r}.{hint} Valid: {', '.join(names) if names else '(none)'}."


def install_extra(extra: str) -> str:
    """Return how an extra is installed. The package is on no index: its name there could be someone else's."""
    return (
        f"In the folder of this project: `make venv`, or `pip install -e '.[{extra}]'` in an environment of your own."
    )


def quoted(value: object) -> str:
    """Return a value as a shell reads it back, for a command in a message: a path may hold spaces."""
    return shlex.quote(str(value))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 episode``, ``2 episodes``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def brief(values: Iterable[object], shown: int = 6) -> str:
    """Return the first few of some values, and how many more there are."""
    texts = [str(value) for value in values]
    more = len(texts) - shown
    return ", ".join(texts[:shown]) + (f" and {more} more" if more > 0 else "")
