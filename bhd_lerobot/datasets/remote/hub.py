"""A dataset on the Hub, through its own client: one commit for all that changed, and the tag that LeRobot expects."""

import glob
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bhd_lerobot.datasets.remote.errors import require_token, transfer_errors
from bhd_lerobot.datasets.remote.listing import RemoteFile
from bhd_lerobot.datasets.remote.place import check_repo_id
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import TransferError, brief

if TYPE_CHECKING:
    from huggingface_hub import HfApi

MAIN = "main"
VERSION_TAG = layout.CODEBASE_VERSION
"""Stock LeRobot requests this revision if none is named."""


class HubDataset:
    """A dataset repository.

    Attributes:
        revision: branch, tag or commit; None for what stock LeRobot takes.
        commit: hash of the commit that `files` listed; None before, and if there is no repository yet.
    """

    folder: Path | None = None
    has_checksums = True

    def __init__(
        self,
        repo_id: str,
        revision: str | None = None,
        *,
        private: bool | None = None,
        tag: str | None = None,
        create: bool = False,
    ) -> None:
        self.name, self.revision = check_repo_id(repo_id), revision
        self.commit: str | None = None
        self._private, self._tag, self._create = private, tag, create
        self._branch, self._listed = revision or MAIN, set[str]()

    def files(self) -> dict[str, RemoteFile]:
        """Return all files of the revision by path; makes the repository first if it was opened with `create`."""
        if self._create:
            self._make()
        with transfer_errors(self.name, "read", revision=self.revision):
            wanted = self._branch
            if not self._create and self.revision is None and VERSION_TAG in self._tags():
                wanted = VERSION_TAG
            info = self._api.repo_info(self.name, repo_type="dataset", revision=wanted)
            if self._create and self._private is not None and bool(info.private) != self._private:
                is_now, wanted = ("private", "public") if info.private else ("public", "private")
                raise TransferError(
                    f"{self.name} exists and is {is_now}; {wanted} was requested. Change that on its page on the Hub, "
                    "or choose another name."
                )
            self.commit = info.sha
            tree = self._api.list_repo_tree(self.name, repo_type="dataset", revision=info.sha, recursive=True)
            files = {one.path: _file(one) for one in tree if hasattr(one, "blob_id")}
            self._listed = set(files)
            return files

    def read(self, path: str) -> bytes:
        """Return a file of the listed commit."""
        with tempfile.TemporaryDirectory() as folder:
            self.fetch([path], Path(folder))
            return Path(folder, path).read_bytes()

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Download files of the listed commit."""
        from huggingface_hub import snapshot_download

        others = self._listed - set(paths)  # the client compares each file with each pattern
        wanted = ("allow_patterns", paths) if len(paths) < len(others) else ("ignore_patterns", others)
        options: dict[str, Any] = {wanted[0]: [glob.escape(path) for path in wanted[1]], "local_dir": folder}
        with transfer_errors(self.name, "download", revision=self.revision):
            snapshot_download(self.name, repo_type="dataset", revision=self.commit, **options)

    def send(self, files: Mapping[str, Path], deleted: Sequence[str], check: Callable[[], None]) -> None:
        """Upload files and remove others in one commit, and set the tags.

        `HfApi.upload_folder` makes several commits of a large folder, between which a reader would find a mixture.
        """
        with transfer_errors(self.name, "upload the dataset to", revision=self.revision):
            found = self._tags().get(self._tag or "")
            if found is not None and (files or deleted or found != self.commit):
                raise TransferError(
                    f"{self.name} has a tag {self._tag!r} already, which marks another version. Choose another."
                )
            if files or deleted:
                self._commit(files, deleted, check)
            for tag in (VERSION_TAG if self._branch == MAIN else None, self._tag):
                if tag is not None:
                    self._set_tag(tag)

    @property
    def _api(self) -> "HfApi":
        from huggingface_hub import HfApi

        return HfApi(library_name="bhd_lerobot")

    def _tags(self) -> dict[str, str]:
        refs = self._api.list_repo_refs(self.name, repo_type="dataset")
        return {tag.name: tag.target_commit for tag in refs.tags}

    def _make(self) -> None:
        require_token(self.name)
        with transfer_errors(self.name, "create the repository", revision=self.revision):
            self._api.create_repo(self.name, repo_type="dataset", private=self._private, exist_ok=True)
            if self._branch in self._tags():
                raise TransferError(f"Could not write to {self.name}: {self._branch!r} is a tag. Name a branch.")
            if self._branch != MAIN:
                self._api.create_branch(self.name, branch=self._branch, repo_type="dataset", exist_ok=True)

    def _commit(self, files: Mapping[str, Path], deleted: Sequence[str], check: Callable[[], None]) -> None:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        additions = [CommitOperationAdd(path, str(file)) for path, file in files.items()]
        place: dict[str, Any] = {"repo_id": self.name, "repo_type": "dataset", "revision": self._branch}
        # At first all the content, which takes long and is not visible yet; what arrived is not sent again.
        self._api.preupload_lfs_files(additions=additions, free_memory=False, **place)
        if ignored := [addition.path_in_repo for addition in additions if getattr(addition, "_should_ignore", False)]:
            raise TransferError(
                f"Could not upload the dataset to {self.name}: the repository's .gitignore names "
                f"{brief(sorted(ignored))}, and the Hub would leave them out. Change that file there; "
                "nothing was changed."
            )
        check()
        removals = [CommitOperationDelete(path) for path in deleted]
        self.commit = self._api.create_commit(
            operations=[*removals, *additions], commit_message="Dataset", parent_commit=self.commit, **place
        ).oid

    def _set_tag(self, tag: str) -> None:
        """Let a tag point at the pushed commit. A tag cannot be moved, so it is gone for a moment, as with LeRobot."""
        found = self._tags().get(tag)
        if found == self.commit:
            return
        if found is not None:
            self._api.delete_tag(self.name, tag=tag, repo_type="dataset")
        self._api.create_tag(self.name, tag=tag, revision=self.commit, repo_type="dataset")


def _file(entry: Any) -> RemoteFile:
    if entry.lfs is not None:
        return RemoteFile(entry.lfs.size, entry.lfs.sha256)
    return RemoteFile(entry.size, entry.blob_id)
