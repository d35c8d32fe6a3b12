"""What the Hub of the tests answers: the part of the protocol that the real client uses for repositories.

Written from what `huggingface_hub` sends and expects; it is not the Hub's own code.
"""

import base64
import hashlib
import json
import re
from urllib.parse import parse_qs, urlsplit

from .repository import LFS_SUFFIXES, Blob, Repository, entries
from .transport import Handler, RefusalError

_REPO = r"(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"


ROUTES = [
    ("POST", "/api/repos/create", "create"),
    ("DELETE", "/api/repos/delete", "delete"),
    ("POST", "/api/validate-yaml", "validate"),
    ("GET", rf"/api/{_REPO}", "info"),
    ("GET", rf"/api/{_REPO}/revision/(?P<revision>.+)", "info"),
    ("GET", rf"/api/{_REPO}/refs", "refs"),
    ("GET", rf"/api/{_REPO}/tree/(?P<revision>[^/]+)(?:/(?P<path>.+))?", "tree"),
    ("POST", rf"/api/{_REPO}/preupload/(?P<revision>.+)", "preupload"),
    ("POST", rf"/api/{_REPO}/commit/(?P<revision>.+)", "commit"),
    ("POST DELETE", rf"/api/{_REPO}/tag/(?P<revision>.+)", "tag"),
    ("POST", rf"/api/{_REPO}/branch/(?P<revision>.+)", "branch"),
    ("POST", r"/(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)\.git/info/lfs/objects/batch", "batch"),
    ("PUT", r"/lfs/(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)/(?P<oid>[0-9a-f]{64})", "put"),
    ("GET HEAD", r"/(?P<kind>datasets/)?(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
]


class HubHandler(Handler):
    """Answers for one connection."""

    routes = ROUTES

    def _user(self) -> tuple[str, bool]:
        """Return who asks, and whether the token may write; nobody has no name."""
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ").strip()
        if not token:
            return "", False
        if token in self.hub.expired or token not in self.hub.tokens:
            raise RefusalError(401, "Invalid credentials in Authorization header")
        return self.hub.tokens[token], not token.startswith("read")

    def _repository(self, kind: str, name: str, *, write: bool = False) -> Repository:
        user, may_write = self._user()
        found = self.hub.repositories.get(f"{kind}/{name}")
        if found is None or (found.private and user != name.partition("/")[0]):
            raise RefusalError(404 if user else 401, "Repository not found", "RepoNotFound")
        if write and not (may_write and user == name.partition("/")[0]):
            raise RefusalError(403 if user else 401, "You don't have the required permission")
        return found

    def _revision(self, repository: Repository, revision: str) -> str:
        oid = repository.find(revision)
        if oid is None:
            raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return oid

    def _create(self, body: bytes) -> None:
        wanted = json.loads(body)
        user, may_write = self._user()
        kind = f"{wanted.get('type') or 'model'}s"
        name = f"{wanted.get('organization') or user}/{wanted['name']}"
        if not user:
            raise RefusalError(401, "Invalid username or password.")
        if user != name.partition("/")[0] or not may_write:
            raise RefusalError(403, f"You don't have the rights to create a {kind[:-1]} under this namespace")
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
        self._answer(entries(files, path or "", recursive=recursive))

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
            raise RefusalError(400, "the content does not have this hash")
        with self.hub.lock:
            self.hub.repositories[f"{kind}/{name}"].objects[oid] = body
            self.hub.received += len(body)
        self._answer({})

    def _commit(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if revision not in repository.branches:
            raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        with self.hub.lock:
            files = dict(repository.files(revision))
            for line in body.splitlines():
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
        url = f"{self.hub.url}/{'' if kind == 'models' else kind + '/'}{name}/commit/{oid}"
        self._answer({"success": True, "commitOid": oid, "commitUrl": url})

    def _tag(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if self.command == "DELETE":
            if repository.tags.pop(revision, None) is None:
                raise RefusalError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        else:
            tag = json.loads(body)["tag"]
            if tag in repository.tags:
                raise RefusalError(409, "Tag reference exists already")
            repository.tags[tag] = self._revision(repository, revision)
        self._answer({})

    def _branch(self, body: bytes, kind: str, name: str, revision: str) -> None:
        repository = self._repository(kind, name, write=True)
        if revision in repository.branches:
            raise RefusalError(409, "Reference already exists")
        start = json.loads(body or b"{}").get("startingPoint") or "main"
        repository.branches[revision] = self._revision(repository, start)
        self._answer({})

    def _resolve(self, _: bytes, name: str, revision: str, path: str, kind: str | None = None) -> None:
        repository = self._repository((kind or "models/").rstrip("/"), name)
        oid = self._revision(repository, revision)
        blob = repository.commits[oid].get(path)
        if blob is None:
            raise RefusalError(404, "Entry not found", "EntryNotFound")
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
