"""What the Hub of the tests keeps: repositories with commits, branches, tags and LFS objects, in memory."""

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

LFS_SUFFIXES = (".parquet", ".mp4", ".safetensors", ".png", ".bin")


@lru_cache(256)
def _sha(content: bytes, algorithm: str, prefix: bytes = b"") -> str:
    return hashlib.new(algorithm, prefix + content).hexdigest()


@dataclass
class Blob:
    """A file's content, and whether it is stored as LFS."""

    content: bytes
    lfs: bool

    @property
    def oid(self) -> str:
        """Its git name; of an LFS file, one that follows from its checksum."""
        return self.sha256[:40] if self.lfs else _sha(self.content, "sha1", b"blob %d\0" % len(self.content))

    @property
    def sha256(self) -> str:
        """Its checksum."""
        return _sha(self.content, "sha256")


@dataclass
class Repository:
    """A repository: commits by hash, and what points at them."""

    private: bool = False
    commits: dict[str, dict[str, Blob]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Start as the Hub does: with one commit."""
        self.add("main", {".gitattributes": Blob(b"*.parquet filter=lfs\n", lfs=False)})

    def add(self, branch: str, files: dict[str, Blob]) -> str:
        """Add a commit to a branch; return its hash."""
        parent = self.branches.get(branch, "")
        text = f"{len(self.commits)}{parent}{sorted((path, blob.oid) for path, blob in files.items())}"
        oid = hashlib.sha1(text.encode()).hexdigest()
        self.commits[oid] = files
        self.branches[branch] = oid
        return oid

    def find(self, revision: str) -> str | None:
        """Return the hash that a branch, a tag or a hash stands for."""
        found = self.branches.get(revision) or self.tags.get(revision)
        return found or (revision if revision in self.commits else None)

    def files(self, revision: str = "main") -> dict[str, Blob]:
        """Return the files of a revision."""
        oid = self.find(revision)
        assert oid is not None, revision
        return self.commits[oid]


def entries(files: dict[str, Blob], folder: str, *, recursive: bool) -> list[dict[str, Any]]:
    prefix = f"{folder}/" if folder else ""
    found: dict[str, dict[str, Any]] = {}
    for path, blob in sorted(files.items()):
        if not path.startswith(prefix):
            continue
        rest = path.removeprefix(prefix)
        for number in range(1, rest.count("/") + 1 if recursive else min(rest.count("/"), 1) + 1):
            name = prefix + "/".join(rest.split("/")[:number])
            found.setdefault(name, {"type": "directory", "oid": "0" * 40, "size": 0, "path": name})
        if recursive or "/" not in rest:
            entry: dict[str, Any] = {"type": "file", "oid": blob.oid, "size": len(blob.content), "path": path}
            if blob.lfs:
                entry["lfs"] = {"oid": blob.sha256, "size": len(blob.content), "pointerSize": 130}
            found[path] = entry
    return list(found.values())
