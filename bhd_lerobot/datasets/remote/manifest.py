"""The list of files beside a dataset below a URL: what they are, and which push wrote it last."""

import json
from dataclasses import dataclass, field

from bhd_lerobot.datasets.remote.listing import LISTED, RemoteFile


@dataclass
class Manifest:
    """What the list says.

    Attributes:
        files: files that are known, by path.
        info: the `meta/info.json` that was shown last, while another one is on its way; empty if none is known.
        push: stands for the push that wrote the list last. Each push writes it before anything else and looks at it
            again before it shows what it sent, so that two at once notice each other.
    """

    files: dict[str, RemoteFile] = field(default_factory=dict)
    info: str = ""
    push: str = ""

    def to_json(self) -> bytes:
        """Return it as it is stored."""
        files = {path: {"size": one.size, LISTED: one.digest} for path, one in sorted(self.files.items())}
        return json.dumps({"format": 1, "push": self.push, "info": self.info, "files": files}, indent=1).encode()


def parse_manifest(content: bytes) -> Manifest:
    """Return what a list says; nothing if it cannot be read, as after a kill: then all is compared by sending it."""
    try:
        found = json.loads(content)
        files = {path: RemoteFile(int(one["size"]), str(one[LISTED]), LISTED) for path, one in found["files"].items()}
        return Manifest(files, str(found.get("info", "")), str(found.get("push", "")))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return Manifest()
