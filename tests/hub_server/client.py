"""The real client of the Hub, in this process, pointed to a server of the tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .server import HubServer


@contextmanager
def real_client(server: "HubServer | str", token: str | None = "hf_me") -> Iterator[Any]:
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
