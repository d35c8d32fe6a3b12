"""A dataset on the Hub, through its own client: one commit for all that changed, and the tag that LeRobot looks for."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bhd_lerobot.datasets.remote.hub_errors import hub_errors, require_token
from bhd_lerobot.datasets.remote.listing import (
    Item,
    RemoteFile,
    check_repo_id,
    in_order,
    largest_first,
    listed,
    refuse_damaged,
)
from bhd_lerobot.datasets.remote.pool import run_all
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import ConfigError, TransferError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

MAIN = "main"
VERSION_TAG = layout.CODEBASE_VERSION
"""Stock LeRobot asks for this revision if it is told none."""

_COMMIT_SIZE = 500
"""Files in a commit; the Hub gives up on much larger ones. Nearly every dataset of ours fits into one."""


class HubDataset:
    """A dataset repository.

    Attributes:
        name: `user/name`.
        folder: None: it does not lie on this machine.
        revision: branch, tag or commit; None for what stock LeRobot takes.
        commit: hash of the commit that `files` listed; None before, and if there is no repository yet.
    """

    folder: Path | None = None

    def __init__(
        self,
        repo_id: str,
        revision: str | None = None,
        *,
        private: bool | None = None,
        tag: str | None = None,
        create: bool = False,
    ) -> None:
        """Name it; nothing is asked for yet.

        Args:
            repo_id: `user/name`.
            revision: branch, tag or commit to read; the branch to write.
            private: whether a repository that is made is private; None leaves it to the Hub.
            tag: a further tag that a push sets.
            create: make the repository and the branch where they do not exist, for a push.

        Raises:
            ConfigError: it is no name.
        """
        self.name, self.revision = check_repo_id(repo_id), revision
        self.commit: str | None = None
        self._private, self._tag, self._create = private, tag, create
        self._refs: Any = None
        self._listed: dict[str, RemoteFile] = {}

    def files(self) -> dict[str, RemoteFile]:
        """Return all files of the revision by path; makes the repository first if it was opened with `create`.

        Raises:
            TransferError: there is no such repository or revision, or no permission.
        """
        if self._create:
            self._make()
        with hub_errors(self.name, "read", revision=self.revision):
            api = self._api
            info = api.repo_info(self.name, repo_type="dataset", revision=self._wanted())
            if self._create and self._private is not None and bool(info.private) != self._private:
                is_now, wanted = ("private", "public") if info.private else ("public", "private")
                raise TransferError(
                    f"{self.name} exists and is {is_now}; {wanted} was asked for. Change that on its page on the Hub, "
                    "or choose another name."
                )
            self.commit = info.sha
            tree = api.list_repo_tree(self.name, repo_type="dataset", revision=self.commit, recursive=True)
            self._listed = {one.path: _file(one) for one in tree if hasattr(one, "blob_id")}
            return dict(self._listed)

    def read(self, path: str) -> bytes | None:
        """Return a file of the listed commit; None if it has none of this name."""
        return self._read(path, self.commit)

    def former_info(self) -> bytes | None:
        """Return the `meta/info.json` of the tagged commit: the tag moves when a push of several commits has ended."""
        commit = self._commit_of(VERSION_TAG) if self._branch == MAIN else None
        return None if commit is None else self._read(layout.INFO, commit)

    def _read(self, path: str, commit: str | None) -> bytes | None:
        from huggingface_hub import hf_hub_url
        from huggingface_hub.errors import EntryNotFoundError
        from huggingface_hub.utils import build_hf_headers, get_session, hf_raise_for_status

        with hub_errors(self.name, f"read {path} of", revision=self.revision):
            url = hf_hub_url(self.name, path, repo_type="dataset", revision=commit)
            answer = get_session().get(url, headers=build_hf_headers(), timeout=30)
            try:
                hf_raise_for_status(answer)
            except EntryNotFoundError:
                return None
            return bytes(answer.content)

    def verified(self, paths: Sequence[str]) -> dict[str, RemoteFile]:
        """Refuse: the Hub names a file by what is in it.

        Raises:
            ConfigError: always.
        """
        raise ConfigError(
            f"{self.name} is on the Hub, which makes the checksums from the contents itself; there is nothing to "
            "verify. Leave --verify out."
        )

    def fetch(self, paths: Sequence[str], folder: Path) -> None:
        """Download files of the listed commit.

        Raises:
            TransferError: not all of them came, or one came otherwise; those that came well are kept.
        """
        from huggingface_hub import hf_hub_download

        def fetch_one(path: str) -> None:
            # By the commit's hash: with a name, the client would fall back to what it has if the Hub is away.
            hf_hub_download(self.name, path, repo_type="dataset", revision=self.commit, local_dir=folder)
            refuse_damaged(folder / path, self._listed[path], self.name, path)

        with hub_errors(self.name, "download", revision=self.revision):
            run_all(fetch_one, largest_first(paths, self._listed))

    def send(self, items: Sequence[Item], deleted: Sequence[str], check: Callable[[], None]) -> None:
        """Upload files, remove others, and set the tags.

        Raises:
            TransferError: not all was uploaded. What was is not sent again, and nobody sees it before all of it is.
        """
        with hub_errors(self.name, "upload the dataset to", revision=self.revision):
            found = self._commit_of(self._tag)
            if found is not None and (items or deleted or found != self.commit):
                raise TransferError(
                    f"{self.name} has a tag {self._tag!r} already, which stands for something else. Choose another."
                )
            if items or deleted:
                self._commit(items, deleted, check)
            if self._branch == MAIN:
                self._set_tag(VERSION_TAG)
            if self._tag is not None:
                self._set_tag(self._tag)

    @property
    def _api(self) -> "HfApi":
        from huggingface_hub import HfApi

        return HfApi(library_name="bhd_lerobot")

    @property
    def _branch(self) -> str:
        return self.revision or MAIN

    def _wanted(self) -> str:
        """Return the revision to look at: for a reader who names none, the one that stock LeRobot takes."""
        if self._create or self.revision is not None:
            return self._branch
        refs = self._list_refs()
        return VERSION_TAG if any(tag.name == VERSION_TAG for tag in refs.tags) else MAIN

    def _list_refs(self) -> Any:
        if self._refs is None:
            self._refs = self._api.list_repo_refs(self.name, repo_type="dataset")
        return self._refs

    def _make(self) -> None:
        require_token(self.name)
        with hub_errors(self.name, "create the repository", revision=self.revision):
            api = self._api
            api.create_repo(self.name, repo_type="dataset", private=self._private, exist_ok=True)
            refs = self._list_refs()
            if any(tag.name == self._branch for tag in refs.tags):
                raise TransferError(f"Could not write to {self.name}: {self._branch!r} is a tag. Name a branch.")
            if self._branch != MAIN and all(branch.name != self._branch for branch in refs.branches):
                api.create_branch(self.name, branch=self._branch, repo_type="dataset", exist_ok=True)

    def _commit(self, items: Sequence[Item], deleted: Sequence[str], check: Callable[[], None]) -> None:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        by_path = {item.path: item for item in items}
        additions = [
            CommitOperationAdd(path, by_path[path].content)
            for path in in_order(by_path)  # info.json in the last one
        ]
        # At first all the content, which is long and which nobody sees; what arrived is not sent again.
        self._api.preupload_lfs_files(
            self.name, additions, repo_type="dataset", revision=self._branch, free_memory=False
        )
        if ignored := [one.path_in_repo for one in additions if getattr(one, "_should_ignore", False)]:
            raise TransferError(
                f"Could not upload the dataset to {self.name}: the repository's .gitignore names {listed(ignored)}, "
                "and the Hub would leave them out. Change that file there; nothing was changed."
            )
        removals = [CommitOperationDelete(path) for path in deleted]
        operations: list[CommitOperationAdd | CommitOperationDelete] = [*removals, *additions]
        if len(operations) > _COMMIT_SIZE and layout.INFO in self._listed:
            # A reader who comes between two commits finds no dataset; better than one that is of two versions. What
            # arrives with the last commit must be a new operation: the client leaves out what it has seen there.
            operations = [one for one in operations if one.path_in_repo != layout.INFO]
            content = by_path[layout.INFO].content if layout.INFO in by_path else self._info()
            operations = [CommitOperationDelete(layout.INFO), *operations, CommitOperationAdd(layout.INFO, content)]
        count = -(-len(operations) // _COMMIT_SIZE)
        parent = self.commit
        for number in range(count):
            check()
            part = f", part {number + 1} of {count}" if count > 1 else ""
            info = self._api.create_commit(
                self.name,
                operations[number * _COMMIT_SIZE : (number + 1) * _COMMIT_SIZE],
                commit_message=f"Dataset{part}",
                repo_type="dataset",
                revision=self._branch,
                parent_commit=parent,
            )
            parent = info.oid
        self.commit = parent

    def _info(self) -> bytes:
        """Return the `meta/info.json` of the listed commit, which stays as it is while others change."""
        content = self.read(layout.INFO)
        if content is None:
            raise TransferError(f"Could not upload the dataset to {self.name}: its {layout.INFO} is gone.")
        return content

    def _commit_of(self, tag: str | None) -> str | None:
        return next((one.target_commit for one in self._list_refs().tags if one.name == tag), None)

    def _set_tag(self, tag: str) -> None:
        """Let a tag point at the pushed commit. A tag cannot be moved, so it is gone for a moment, as with LeRobot."""
        self._refs = None  # somebody may have pushed since they were read
        heads = {branch.name: branch.target_commit for branch in self._list_refs().branches}
        if tag == VERSION_TAG and heads.get(self._branch, self.commit) != self.commit:
            return  # a later push, which sets this tag itself; it must not go back
        found = self._commit_of(tag)
        if found == self.commit:
            return
        api = self._api
        if found is not None:
            api.delete_tag(self.name, tag=tag, repo_type="dataset")
        api.create_tag(self.name, tag=tag, revision=self.commit, repo_type="dataset")


def _file(entry: Any) -> RemoteFile:
    if entry.lfs is not None:
        return RemoteFile(entry.lfs.size, entry.lfs.sha256)
    return RemoteFile(entry.size, entry.blob_id, "git")
