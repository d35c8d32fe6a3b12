"""A Hub in this process, behind the real client: what `huggingface_hub` sends is answered without a network.

It knows users by their tokens, lists what it was asked, and fails on demand. Written from what the client sends and
expects; it is not the Hub's own code.
"""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any
from urllib.parse import unquote

import httpx
import pytest

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
    """A repository: commits by hash, and what points at them; it begins with one commit, as on the Hub."""

    private: bool = False
    commits: dict[str, dict[str, Blob]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.add("main", {".gitattributes": Blob(b"*.parquet filter=lfs\n", lfs=False)})

    def add(self, branch: str, files: dict[str, Blob]) -> str:
        """Add a commit to a branch; return its hash."""
        parent = self.branches.get(branch, "")
        text = f"{len(self.commits)}{parent}{sorted((path, blob.oid) for path, blob in files.items())}"
        oid = hashlib.sha1(text.encode()).hexdigest()
        self.commits[oid] = files
        self.branches[branch] = oid
        return oid

    def commit(self, revision: str) -> str:
        """Return the hash that a branch, a tag or a hash stands for."""
        found = self.branches.get(revision) or self.tags.get(revision) or revision
        if found not in self.commits:
            raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return found

    def files(self, revision: str = "main") -> dict[str, Blob]:
        """Return the files of a revision."""
        return self.commits[self.commit(revision)]


@dataclass
class Fault:
    """What goes wrong with requests that match.

    Attributes:
        request: pattern for `METHOD path`.
        times: how often; -1 for ever.
        status: answered instead; 0 to cut the connection.
        after_bytes: so many bytes of an answer pass before that.
        meanwhile: nothing else goes wrong, but this is called before the answer.
        after: requests that match and pass before the first that fails.
    """

    request: str
    times: int = 1
    status: int = 0
    after_bytes: int = 0
    meanwhile: Callable[[], object] | None = None
    after: int = 0


class RefusalError(Exception):
    """An answer with an error status."""

    def __init__(self, status: int, message: str = "", code: str = "") -> None:
        self.status, self.message, self.code = status, message, code


_REPO = r"(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"
_PLACE = r"(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)"
ROUTES = [
    ("POST", "/api/repos/create", "create"),
    ("GET", rf"/api/{_REPO}", "info"),
    ("GET", rf"/api/{_REPO}/revision/(?P<revision>.+)", "info"),
    ("GET", rf"/api/{_REPO}/refs", "refs"),
    ("GET", rf"/api/{_REPO}/tree/(?P<revision>[^/]+)(?:/(?P<path>.+))?", "tree"),
    ("POST", rf"/api/{_REPO}/preupload/(?P<revision>.+)", "preupload"),
    ("POST", rf"/api/{_REPO}/commit/(?P<revision>.+)", "commit"),
    ("POST DELETE", rf"/api/{_REPO}/tag/(?P<revision>.+)", "tag"),
    ("POST", rf"/api/{_REPO}/branch/(?P<revision>.+)", "branch"),
    ("POST", rf"/{_PLACE}\.git/info/lfs/objects/batch", "batch"),
    ("PUT", rf"/lfs/{_REPO}/(?P<oid>[0-9a-f]{{64}})", "put"),
    ("GET HEAD", rf"/{_PLACE}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
    ("POST", "/api/validate-yaml", "validate"),
]
"""Methods, pattern of the path, and the name of what answers."""


class FakeHub:
    """The Hub.

    Attributes:
        tokens: user by token; a token that starts with `read` may not write.
        expired: tokens that are not accepted any more.
        repositories: by `datasets/user/name` or `models/user/name`.
        faults: what goes wrong.
        requests: `METHOD path` of every request, in order.
        received: bytes of LFS objects that came in.
        is_down: nobody answers.
    """

    def __init__(self) -> None:
        self.tokens = {"hf_me": "me", "read_me": "me", "hf_other": "other"}
        self.expired: set[str] = set()
        self.repositories: dict[str, Repository] = {}
        self.lock = threading.RLock()
        self.reset()

    def dataset(self, name: str) -> Repository:
        """Return a dataset repository."""
        return self.repositories[f"datasets/{name}"]

    def reset(self) -> None:
        """Forget faults and counts, not the repositories."""
        self.faults: list[Fault] = []
        self.requests: list[str] = []
        self.received, self.is_down = 0, False

    def asked(self, pattern: str) -> list[str]:
        """Return the requests that match."""
        return [request for request in self.requests if re.search(pattern, request)]

    def answer(self, request: httpx.Request) -> httpx.Response:
        """Answer a request; the handler of a `httpx.MockTransport`."""
        if self.is_down:
            raise httpx.ConnectError("Connection refused")
        path = unquote(request.url.path)
        line = f"{request.method} {path}"
        fault = self._met(line)
        try:
            if fault is not None and fault.meanwhile is not None:
                fault.meanwhile()
            elif fault is not None and fault.status:
                raise RefusalError(fault.status, "on demand")
            elif fault is not None and request.method != "GET":
                raise httpx.RemoteProtocolError("the connection was cut")
            response = self._respond(request, path)
        except RefusalError as refusal:
            headers = {"X-Error-Message": refusal.message, "X-Error-Code": refusal.code}
            given = {name: text for name, text in headers.items() if text}
            return httpx.Response(refusal.status, headers=given, json={"error": refusal.message})
        if fault is not None and fault.meanwhile is None:
            cut = _Cut(response.content[: fault.after_bytes])
            return httpx.Response(response.status_code, headers=response.headers, stream=cut)
        return response

    def _met(self, line: str) -> Fault | None:
        with self.lock:
            self.requests.append(line)
            fault = next((one for one in self.faults if one.times and re.search(one.request, line)), None)
            if fault is None:
                return None
            if fault.after > 0:
                fault.after -= 1
                return None
            fault.times -= 1
            return fault

    def _respond(self, request: httpx.Request, path: str) -> httpx.Response:
        for methods, pattern, name in ROUTES:
            match = re.fullmatch(pattern, path)
            if match and request.method in methods.split():
                return getattr(self, f"_{name}")(request, **match.groupdict())  # type: ignore[no-any-return]
        raise RefusalError(404, f"no such route: {request.method} {path}")

    def _user(self, request: httpx.Request) -> tuple[str, bool]:
        """Return who asks, and whether the token may write; nobody has no name."""
        token = request.headers.get("Authorization", "").removeprefix("Bearer ").strip()
        if not token:
            return "", False
        if token in self.expired or token not in self.tokens:
            raise RefusalError(401, "Invalid credentials in Authorization header")
        return self.tokens[token], not token.startswith("read")

    def _repository(self, request: httpx.Request, kind: str | None, name: str, *, write: bool = False) -> Repository:
        user, may_write = self._user(request)
        found = self.repositories.get(f"{(kind or 'models').rstrip('/')}/{name}")
        if found is None or (found.private and user != name.partition("/")[0]):
            raise RefusalError(404 if user else 401, "Repository not found", "RepoNotFound")
        if write and not (may_write and user == name.partition("/")[0]):
            raise RefusalError(403 if user else 401, "You don't have the required permission")
        return found

    def _create(self, request: httpx.Request) -> httpx.Response:
        wanted = json.loads(request.content)
        user, may_write = self._user(request)
        kind = f"{wanted.get('type') or 'model'}s"
        name = f"{wanted.get('organization') or user}/{wanted['name']}"
        if not user:
            raise RefusalError(401, "Invalid username or password.")
        if user != name.partition("/")[0] or not may_write:
            raise RefusalError(403, f"You don't have the rights to create a {kind[:-1]} under this namespace")
        private = wanted.get("visibility") == "private" or bool(wanted.get("private"))
        with self.lock:
            exists = f"{kind}/{name}" in self.repositories
            if not exists:
                self.repositories[f"{kind}/{name}"] = Repository(private=private)
        url = f"{_base(request)}/{'' if kind == 'models' else kind + '/'}{name}"
        return httpx.Response(409 if exists else 200, json={"url": url, "name": name})

    def _validate(self, _: httpx.Request) -> httpx.Response:
        return httpx.Response(200, json={"errors": [], "warnings": []})

    def _info(self, request: httpx.Request, kind: str, name: str, revision: str = "main") -> httpx.Response:
        repository = self._repository(request, kind, name)
        oid = repository.commit(revision)
        siblings = [{"rfilename": path} for path in repository.commits[oid]]
        about = {"id": name, "_id": name, "sha": oid, "private": repository.private, "siblings": siblings, "tags": []}
        return httpx.Response(200, json=about)

    def _tree(
        self, request: httpx.Request, kind: str, name: str, revision: str, path: str | None = None
    ) -> httpx.Response:
        files = self._repository(request, kind, name).files(revision)
        is_recursive = request.url.params.get("recursive", "false").lower() in ("true", "1")
        return httpx.Response(200, json=_entries(files, path or "", recursive=is_recursive))

    def _refs(self, request: httpx.Request, kind: str, name: str) -> httpx.Response:
        repository = self._repository(request, kind, name)
        listed = {
            key: [{"name": one, "ref": f"refs/{word}/{one}", "targetCommit": oid} for one, oid in found.items()]
            for key, word, found in (("branches", "heads", repository.branches), ("tags", "tags", repository.tags))
        }
        return httpx.Response(200, json={**listed, "converts": []})

    def _preupload(self, request: httpx.Request, kind: str, name: str, revision: str) -> httpx.Response:
        files = self._repository(request, kind, name, write=True).files(revision)
        answer = []
        for one in json.loads(request.content)["files"]:
            mode = "lfs" if one["path"].endswith(LFS_SUFFIXES) else "regular"
            known = files.get(one["path"])
            oid = None if known is None else known.sha256 if known.lfs else known.oid
            answer.append({"path": one["path"], "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        return httpx.Response(200, json={"files": answer})

    def _batch(self, request: httpx.Request, name: str, kind: str | None = None) -> httpx.Response:
        known = self._repository(request, kind, name, write=True).objects
        objects = []
        for one in json.loads(request.content)["objects"]:
            href = f"{_base(request)}/lfs/{(kind or 'models').rstrip('/')}/{name}/{one['oid']}"
            actions = {} if one["oid"] in known else {"actions": {"upload": {"href": href, "header": {}}}}
            objects.append({"oid": one["oid"], "size": one["size"], **actions})
        return httpx.Response(200, json={"transfer": "basic", "objects": objects})

    def _put(self, request: httpx.Request, kind: str, name: str, oid: str) -> httpx.Response:
        body = request.content
        if hashlib.sha256(body).hexdigest() != oid:
            raise RefusalError(400, "the content does not have this hash")
        with self.lock:
            self.repositories[f"{kind}/{name}"].objects[oid] = body
            self.received += len(body)
        return httpx.Response(200, json={})

    def _commit(self, request: httpx.Request, kind: str, name: str, revision: str) -> httpx.Response:
        repository = self._repository(request, kind, name, write=True)
        if revision not in repository.branches:
            raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        with self.lock:
            files = dict(repository.files(revision))
            for line in request.content.splitlines():
                one = json.loads(line)
                value = one["value"]
                if one["key"] == "header":
                    if value.get("parentCommit") not in (None, repository.branches[revision]):
                        raise RefusalError(412, "A commit has happened since. Please refresh and try again.")
                elif one["key"] == "file":
                    files[value["path"]] = Blob(base64.b64decode(value["content"]), lfs=False)
                elif one["key"] == "lfsFile":
                    if value["oid"] not in repository.objects:
                        raise RefusalError(400, "the LFS object was not uploaded")
                    files[value["path"]] = Blob(repository.objects[value["oid"]], lfs=True)
                elif one["key"] == "deletedFile" and files.pop(value["path"], None) is None:
                    raise RefusalError(404, "A file with this name doesn't exist", "EntryNotFound")
            oid = repository.add(revision, files)
        url = f"{_base(request)}/{'' if kind == 'models' else kind + '/'}{name}/commit/{oid}"
        return httpx.Response(200, json={"success": True, "commitOid": oid, "commitUrl": url})

    def _tag(self, request: httpx.Request, kind: str, name: str, revision: str) -> httpx.Response:
        repository = self._repository(request, kind, name, write=True)
        if request.method == "DELETE":
            if repository.tags.pop(revision, None) is None:
                raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        else:
            tag = json.loads(request.content)["tag"]
            if tag in repository.tags:
                raise RefusalError(409, "Tag reference exists already")
            repository.tags[tag] = repository.commit(revision)
        return httpx.Response(200, json={})

    def _branch(self, request: httpx.Request, kind: str, name: str, revision: str) -> httpx.Response:
        repository = self._repository(request, kind, name, write=True)
        if revision in repository.branches:
            raise RefusalError(409, "Reference already exists")
        start = json.loads(request.content or b"{}").get("startingPoint") or "main"
        repository.branches[revision] = repository.commit(start)
        return httpx.Response(200, json={})

    def _resolve(
        self, request: httpx.Request, name: str, revision: str, path: str, kind: str | None = None
    ) -> httpx.Response:
        repository = self._repository(request, kind, name)
        oid = repository.commit(revision)
        blob = repository.commits[oid].get(path)
        if blob is None:
            raise RefusalError(404, "Entry not found", "EntryNotFound")
        tag = f'"{blob.sha256 if blob.lfs else blob.oid}"'
        headers = {"X-Repo-Commit": oid, "ETag": tag, "Accept-Ranges": "bytes"}
        if blob.lfs:
            headers |= {"X-Linked-Size": str(len(blob.content)), "X-Linked-Etag": tag}
        content, status = blob.content, 200
        if span := re.fullmatch(r"bytes=(\d+)-(\d*)", request.headers.get("Range", "")):
            first, last = int(span[1]), min(int(span[2] or len(content)), len(content) - 1)
            headers["Content-Range"] = f"bytes {first}-{last}/{len(content)}"
            content, status = content[first : last + 1], 206
        headers["Content-Length"] = str(len(content))
        return httpx.Response(status, headers=headers, content=content if request.method == "GET" else None)


class _Cut(httpx.SyncByteStream):
    """The beginning of an answer, and then no connection."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def __iter__(self) -> Iterator[bytes]:
        yield self._content
        raise httpx.RemoteProtocolError("peer closed connection without sending complete message body")


def _base(request: httpx.Request) -> str:
    return f"{request.url.scheme}://{request.url.netloc.decode()}"


def _entries(files: dict[str, Blob], folder: str, *, recursive: bool) -> list[dict[str, Any]]:
    prefix = f"{folder}/" if folder else ""
    found: dict[str, dict[str, Any]] = {}
    for path, blob in sorted(files.items()):
        if not path.startswith(prefix):
            continue
        folders = path.removeprefix(prefix).split("/")[:-1]
        for number in range(1, len(folders if recursive else folders[:1]) + 1):
            name = prefix + "/".join(folders[:number])
            found.setdefault(name, {"type": "directory", "oid": "0" * 40, "size": 0, "path": name})
        if recursive or not folders:
            entry: dict[str, Any] = {"type": "file", "oid": blob.oid, "size": len(blob.content), "path": path}
            if blob.lfs:
                entry["lfs"] = {"oid": blob.sha256, "size": len(blob.content), "pointerSize": 130}
            found[path] = entry
    return list(found.values())


@contextmanager
def real_client(hub: FakeHub, token: str | None = "hf_me") -> Iterator[None]:
    """Let the real client, in this process, speak to a Hub; it does not wait before it tries again."""
    from huggingface_hub import constants
    from huggingface_hub.utils import _http

    def client() -> httpx.Client:
        hooks = {"request": [_http.hf_request_event_hook]}
        return httpx.Client(transport=httpx.MockTransport(hub.answer), event_hooks=hooks, follow_redirects=True)

    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("HUB_OFFLINE", False), ("HUB_DISABLE_XET", True), ("HUB_DISABLE_PROGRESS_BARS", True)):
            patch.setattr(constants, f"HF_{name}", value)
        patch.setenv("HF_HUB_OFFLINE", "0")
        patch.delenv("HF_TOKEN", raising=False)
        if token is not None:
            patch.setenv("HF_TOKEN", token)
        for module in ("utils._http", "file_download"):  # there alone: the tests themselves do wait
            patch.setattr(f"huggingface_hub.{module}.time", _Hasty())
        patch.setattr(_http, "_GLOBAL_CLIENT_FACTORY", client)  # its setter would wait for itself
        _http.close_session()
        yield
        _http.close_session()


class _Hasty:
    """The module `time`, in which nobody sleeps."""

    def __getattr__(self, name: str) -> Any:
        import time

        return (lambda seconds: None) if name == "sleep" else getattr(time, name)
