"""Which versions of other packages this one supports, as its own metadata say, and which are installed."""

from collections.abc import Callable
from importlib import metadata

# LeRobot requires it, so it is there; its absence would be a finding of its own.
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from bhd_lerobot.errors import VersionError

DISTRIBUTION = "lerobot_robot_bhd"


def required_versions(distribution: str = DISTRIBUTION) -> dict[str, SpecifierSet]:
    """Return which versions of which packages a distribution, ours, requires on this machine, without its extras.

    A package may be named several times; all of that holds at once.

    Raises:
        PackageNotFoundError: it is not installed.
    """
    required: dict[str, SpecifierSet] = {}
    for requirement in map(Requirement, metadata.requires(distribution) or []):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            name = canonicalize_name(requirement.name)
            required[name] = required.get(name, SpecifierSet()) & requirement.specifier
    return required


def check_version(name: str, version_of: Callable[[str], str] = metadata.version) -> None:
    """Check a package before it is imported: one that is installed later may have replaced it by another version.

    Args:
        name: of the distribution.
        version_of: returns the version of an installed package.

    Raises:
        VersionError: it is not installed, or in a version that is not supported.
    """
    try:
        required = required_versions().get(name, SpecifierSet())
    except metadata.PackageNotFoundError:
        return  # a copy of the source that nobody installed: nothing states what it requires
    try:
        found = version_of(name)
    except metadata.PackageNotFoundError as error:
        raise VersionError(
            f"{name} is not installed; {DISTRIBUTION} needs {name}{required}: pip install '{name}{required}'"
        ) from error
    if not required.contains(found, prereleases=True):
        raise VersionError(
            f"{name} is {found}; {DISTRIBUTION} supports {name}{required}. If another package needs this one, give "
            f"each an environment of its own; otherwise: pip install '{name}{required}'"
        )
