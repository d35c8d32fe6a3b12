"""A Hub on this machine: the part of the protocol that the real client uses for repositories, over plain HTTP.

It keeps commits, branches, tags and LFS objects in memory, knows users by their tokens, counts what it is asked, and
fails on demand. Written from what `huggingface_hub` sends and expects; it is not the Hub's own code.
"""

import base64
import hashlib
import json
import re
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self
from urllib.parse import parse_qs, unquote, urlsplit

LFS_SUFFIXES = (".parquet", ".mp4", ".safetensors", ".png", ".bin")
_REPO = r"(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"


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


@dataclass
class Fault:
    """What goes wrong with requests that match.

    Attributes:
        request: pattern for `METHOD path`.
        times: how often; -1 for ever.
        status: answered instead; 0 to answer nothing.
        after_bytes: so many bytes of the request or of the answer pass before the connection is cut.
        wait: an event that the answer waits for.
    """

    request: str
    times: int = 1
    status: int = 0
    after_bytes: int = 0
    wait: threading.Event | None = None
    after: int = 0
    """Requests that match and pass before the first that fails."""


class HubServer:
    """The server; a context manager that runs it in threads.

    Attributes:
        tokens: user by token; a token that starts with `read` may not write.
        expired: tokens that the server does not accept any more.
        repositories: by `datasets/user/name` or `models/user/name`.
        faults: what goes wrong.
        requests: `METHOD path` of every request, in order.
        received: bytes of LFS objects that came in.
        sent: bytes of files that went out.
    """

    def __init__(self) -> None:
        self.tokens = {"hf_me": "me", "read_me": "me", "hf_other": "other"}
        self.expired: set[str] = set()
        self.repositories: dict[str, Repository] = {}
        self.faults: list[Fault] = []
        self.requests: list[str] = []
        self.received = self.sent = 0
        self.lock = threading.RLock()
        handler = type("Handler", (_Handler,), {"hub": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        """What `HF_ENDPOINT` is to be."""
        return f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> Self:
        """Start."""
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()

    def dataset(self, name: str) -> Repository:
        """Return a dataset repository."""
        return self.repositories[f"datasets/{name}"]

    def reset(self) -> None:
        """Forget faults and counts, not the repositories."""
        self.faults, self.requests, self.expired = [], [], set()
        self.received = self.sent = 0

    def asked(self, pattern: str) -> list[str]:
        """Return the requests that match."""
        return [one for one in self.requests if re.search(pattern, one)]


class _RefusalError(Exception):
    """An answer with an error status."""

    def __init__(self, status: int, message: str = "", code: str = "") -> None:
        self.status, self.message, self.code = status, message, code


class _CutError(Exception):
    """The connection ends here."""


class _Handler(BaseHTTPRequestHandler):
    hub: HubServer
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    rbufsize = wbufsize = 1 << 16

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        self._serve()

    do_HEAD = do_GET  # noqa: N815  names of the base class
    do_POST = do_GET  # noqa: N815
    do_PUT = do_GET  # noqa: N815
    do_DELETE = do_GET  # noqa: N815

    def _serve(self) -> None:
        hub = self.hub
        path = unquote(urlsplit(self.path).path)
        line = f"{self.command} {path}"
        with hub.lock:
            hub.requests.append(line)
            self.fault = next((f for f in hub.faults if f.times and re.search(f.request, line)), None)
            if self.fault is not None and self.fault.after > 0:
                self.fault.after -= 1
                self.fault = None
            elif self.fault is not None:
                self.fault.times -= 1
        try:
            body = self._body()
            if self.fault is not None:
                if self.fault.wait is not None:
                    self.fault.wait.wait(60)
                if self.fault.status:
                    raise _RefusalError(self.fault.status, "on demand")
                if self.command != "GET" and self.fault.wait is None:
                    raise _CutError
            for method, pattern, name in _ROUTES:
                match = re.fullmatch(pattern, path)
                if match and self.command in method.split():
                    getattr(self, f"_{name}")(body, **match.groupdict())
                    return
            raise _RefusalError(404, f"no such route: {line}")
        except _RefusalError as refusal:
            self.close_connection = True
            headers = {"X-Error-Message": refusal.message} if refusal.message else {}
            headers |= {"X-Error-Code": refusal.code} if refusal.code else {}
            self._answer({"error": refusal.message}, refusal.status, headers)
        except (_CutError, ConnectionError):
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)

    def _body(self) -> bytes:
        limit = self.fault.after_bytes if self.fault and self.command == "PUT" and not self.fault.status else -1
        if self.headers.get("Transfer-Encoding") == "chunked":
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        size = int(self.headers.get("Content-Length") or 0)
        if limit >= 0 and self.fault is not None and self.fault.wait is None:
            self.rfile.read(min(size, limit))
            raise _CutError
        return self.rfile.read(size)

    def _answer(self, content: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        values = {"Content-Type": "application/json", "Content-Length": str(len(data)), **(headers or {})}
        for key, value in values.items():
            self.send_header(key, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command == "HEAD":
            return
        if self.fault is not None and not self.fault.status and self.fault.wait is None:
            self.wfile.write(data[: self.fault.after_bytes])
            self.wfile.flush()
            raise _CutError
        self.wfile.write(data)

    def _user(self) -> tuple[str, bool]:
        """Return who asks, and whether the token may write; nobody has no name."""
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ").strip()
        if not token:
            return "", False
        if token in self.hub.expired or token not in self.hub.tokens:
            raise _RefusalError(401, "Invalid credentials in Authorization header")
        return self.hub.tokens[token], not token.startswith("read")

    def _repository(self, kind: str, name: str, *, write: bool = False) -> Repository:
        user, may_write = self._user()
        found = self.hub.repositories.get(f"{kind}/{name}")
        if found is None or (found.private and user != name.partition("/")[0]):
            raise _RefusalError(404 if user else 401, "Repository not found", "RepoNotFound")
        if write and not (may_write and user == name.partition("/")[0]):
            raise _RefusalError(403 if user else 401, "You don't have the required permission")
        return found

    def _revision(self, repository: Repository, revision: str) -> str:
        oid = repository.find(revision)
        if oid is None:
            raise _RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return oid

    def _whoami(self, _: bytes) -> None:
        user, _may = self._user()
        if not user:
            raise _RefusalError(401, "Invalid username or password.")
        self._answer({"type": "user", "name": user, "orgs": [], "auth": {"type": "access_token"}})

    def _create(self, body: bytes) -> None:
        wanted = json.loads(body)
        user, may_write = self._user()
        kind = f"{wanted.get('type') or 'model'}s"
        name = f"{wanted.get('organization') or user}/{wanted['name']}"
        if not user:
            raise _RefusalError(401, "Invalid username or password.")
        if user != name.partition("/")[0] or not may_write:
            raise _RefusalError(403, f"You don't have the rights to create a {kind[:-1]} under this namespace")
        url = f"{self.hub.url}/{'' if kind == 'models' else kind + '/'}{name}"
        with self.hub.lock:
            exists = f"{kind}/{name}" in self.hub.repositories
            if not exists:
                private = wanted.get("visibility") == "private" or bool(wanted.get("private"))
                self.hub.repositories[f"{kind}/{name}"] = Repository(private=private)
        self._answer({"url": url, "name": name, **({"error": "exists"} if exists else {})}, 409 if exists else 200)

    def _delete(self, body: bytes) -> None:
        wanted = json.loads(body)
        kind = f"{wanted.get('type') or 'model'}s"
        user, _may = self._user()
        name = f"{wanted.get('organization') or user}/{wanted['name']}"
        self._repository(kind, name, write=True)
        del self.hub.repositories[f"{kind}/{name}"]
        self._answer({})

    def _validate(self, _: bytes) -> None:
        self._answer({"errors": [], "warnings": []})

    def _info(self, _: bytes, kind: str, name: str, revision: str | None = None) -> None:
        repository = self._repository(kind, name)
        oid = self._revision(repository, revision or "main")
        siblings = [{"rfilename": path} for path in repository.commits[oid]]
        self._answer(
            {"id": name, "_id": name, "sha": oid, "private": repository.private, "siblings": siblings, "tags": []}
        )

    def _tree(self, _: bytes, kind: str, name: str, revision: str, path: str | None = None) -> None:
        repository = self._repository(kind, name)
        files = repository.commits[self._revision(repository, revision)]
        query = parse_qs(urlsplit(self.path).query)
        recursive = query.get("recursive", ["false"])[0].lower() in ("true", "1")
        self._answer(_entries(files, path or "", recursive=recursive))

    def _paths(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name)
        files = repository.commits[self._revision(repository, revision)]
        if self.headers.get("Content-Type", "").startswith("application/json"):
            wanted = json.loads(body)["paths"]
        else:
            wanted = parse_qs(body.decode()).get("paths", [])
        every = [one for path in files for one in _entries(files, path.rpartition("/")[0], recursive=False)]
        known = {one["path"]: one for one in every}
        for path in files:
            for number in range(1, path.count("/") + 1):
                folder = "/".join(path.split("/")[:number])
                known.setdefault(folder, {"type": "directory", "oid": "0" * 40, "path": folder, "size": 0})
        self._answer([known[path] for path in wanted if path in known])

    def _refs(self, _: bytes, kind: str, name: str) -> None:
        repository = self._repository(kind, name)
        branches = [
            {"name": one, "ref": f"refs/heads/{one}", "targetCommit": oid} for one, oid in repository.branches.items()
        ]
        tags = [{"name": one, "ref": f"refs/tags/{one}", "targetCommit": oid} for one, oid in repository.tags.items()]
        self._answer({"branches": branches, "tags": tags, "converts": []})

    def _preupload(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        files = repository.commits[self._revision(repository, revision)]
        answer = []
        for one in json.loads(body)["files"]:
            mode = "lfs" if one["path"].endswith(LFS_SUFFIXES) else "regular"
            known = files.get(one["path"])
            oid = None if known is None else known.sha256 if known.lfs else known.oid
            answer.append({"path": one["path"], "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        self._answer({"files": answer})

    def _batch(self, body: bytes, name: str, kind: str | None = None) -> None:
        kind = (kind or "models/").rstrip("/")
        repository = self._repository(kind, name, write=True)
        objects = []
        for one in json.loads(body)["objects"]:
            href = f"{self.hub.url}/lfs/{kind}/{name}/{one['oid']}"
            actions = {} if one["oid"] in repository.objects else {"actions": {"upload": {"href": href, "header": {}}}}
            objects.append({"oid": one["oid"], "size": one["size"], **actions})
        self._answer({"transfer": "basic", "objects": objects})

    def _put(self, body: bytes, kind: str, name: str, oid: str) -> None:
        if hashlib.sha256(body).hexdigest() != oid:
            raise _RefusalError(400, "the content does not have this hash")
        with self.hub.lock:
            self.hub.repositories[f"{kind}/{name}"].objects[oid] = body
            self.hub.received += len(body)
        self._answer({})

    def _commit(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if revision not in repository.branches:
            raise _RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        with self.hub.lock:
            files = dict(repository.files(revision))
            for line in body.splitlines():
                one = json.loads(line)
                value = one["value"]
                if one["key"] == "header":
                    if value.get("parentCommit") not in (None, repository.branches[revision]):
                        raise _RefusalError(412, "A commit has happened since. Please refresh and try again.")
                elif one["key"] == "file":
                    files[value["path"]] = Blob(base64.b64decode(value["content"]), lfs=False)
                elif one["key"] == "lfsFile":
                    if value["oid"] not in repository.objects:
                        raise _RefusalError(400, "the LFS object was not uploaded")
                    files[value["path"]] = Blob(repository.objects[value["oid"]], lfs=True)
                elif one["key"] == "deletedFile":
                    if files.pop(value["path"], None) is None:
                        raise _RefusalError(404, "A file with this name doesn't exist", "EntryNotFound")
                elif one["key"] == "deletedFolder":
                    files = {path: blob for path, blob in files.items() if not path.startswith(value["path"])}
            oid = repository.add(revision, files)
        url = f"{self.hub.url}/{'' if kind == 'models' else kind + '/'}{name}/commit/{oid}"
        self._answer({"success": True, "commitOid": oid, "commitUrl": url})

    def _tag(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if self.command == "DELETE":
            if repository.tags.pop(revision, None) is None:
                raise _RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        else:
            tag = json.loads(body)["tag"]
            if tag in repository.tags:
                raise _RefusalError(409, "Tag reference exists already")
            repository.tags[tag] = self._revision(repository, revision)
        self._answer({})

    def _branch(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if revision in repository.branches:
            raise _RefusalError(409, "Reference already exists")
        start = json.loads(body or b"{}").get("startingPoint") or "main"
        repository.branches[revision] = self._revision(repository, start)
        self._answer({})

    def _resolve(self, _: bytes, name: str, revision: str, path: str, kind: str | None = None) -> None:
        repository = self._repository((kind or "models/").rstrip("/"), name)
        oid = self._revision(repository, revision)
        blob = repository.commits[oid].get(path)
        if blob is None:
            raise _RefusalError(404, "Entry not found", "EntryNotFound")
        headers = {
            "Content-Type": "application/octet-stream",
            "X-Repo-Commit": oid,
            "ETag": f'"{blob.sha256 if blob.lfs else blob.oid}"',
            "Accept-Ranges": "bytes",
        }
        if blob.lfs:
            headers |= {"X-Linked-Size": str(len(blob.content)), "X-Linked-Etag": headers["ETag"]}
        content, status = blob.content, 200
        span = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
        if span:
            first, last = int(span[1]), int(span[2] or len(content) - 1)
            headers["Content-Range"] = f"bytes {first}-{min(last, len(content) - 1)}/{len(content)}"
            content, status = content[first : last + 1], 206
        if self.command == "GET":
            with self.hub.lock:
                self.hub.sent += len(content)
        self._answer(content, status, headers)


def _entries(files: dict[str, Blob], folder: str, *, recursive: bool) -> list[dict[str, Any]]:
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


_ROUTES = [
    ("GET", "/api/whoami-v2", "whoami"),
    ("POST", "/api/repos/create", "create"),
    ("DELETE", "/api/repos/delete", "delete"),
    ("POST", "/api/validate-yaml", "validate"),
    ("GET", rf"/api/{_REPO}", "info"),
    ("GET", rf"/api/{_REPO}/revision/(?P<revision>.+)", "info"),
    ("GET", rf"/api/{_REPO}/refs", "refs"),
    ("GET", rf"/api/{_REPO}/tree/(?P<revision>[^/]+)(?:/(?P<path>.+))?", "tree"),
    ("POST", rf"/api/{_REPO}/paths-info/(?P<revision>[^/]+)", "paths"),
    ("POST", rf"/api/{_REPO}/preupload/(?P<revision>.+)", "preupload"),
    ("POST", rf"/api/{_REPO}/commit/(?P<revision>.+)", "commit"),
    ("POST DELETE", rf"/api/{_REPO}/tag/(?P<revision>.+)", "tag"),
    ("POST", rf"/api/{_REPO}/branch/(?P<revision>.+)", "branch"),
    ("POST", r"/(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)\.git/info/lfs/objects/batch", "batch"),
    ("PUT", r"/lfs/(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)/(?P<oid>[0-9a-f]{64})", "put"),
    ("GET HEAD", r"/(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
]


@contextmanager
def real_client(server: HubServer | str, token: str | None = "hf_me") -> Iterator[Any]:
    """Point the real client, in this process, to a server, or its address; yields a `pytest.MonkeyPatch` for more.

    The client reads its environment when it is imported, so its constants are changed.
    """
    import pytest
    from huggingface_hub import RepoCard, constants
    from huggingface_hub.utils import _http

    url = server if isinstance(server, str) else server.url
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "ENDPOINT", url)
        patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", f"{url}/{{repo_id}}/resolve/{{revision}}/{{filename}}")
        patch.setattr(constants, "HF_HUB_OFFLINE", False)
        patch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        patch.setattr(constants, "HF_HUB_DISABLE_PROGRESS_BARS", True)
        # To check a model's card it asks the Hub on the internet, whatever HF_ENDPOINT is.
        patch.setattr(RepoCard, "validate", lambda card, repo_type=None: None)
        patch.setenv("HF_ENDPOINT", url)
        patch.setenv("HF_HUB_OFFLINE", "0")
        patch.delenv("HF_TOKEN", raising=False)
        if token is not None:
            patch.setenv("HF_TOKEN", token)
        _http.close_session()
        yield patch
        _http.close_session()


if __name__ == "__main__":  # in a process of its own, until its input ends
    with HubServer() as running:
        print(running.url, flush=True)
        sys.stdin.read()
