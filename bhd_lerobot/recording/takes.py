"""Takes on their way into the dataset: saved while a person sets up the next scene, who may still discard the last."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

from bhd_lerobot.rollout.types import Episode


class Takes:
    """Saves takes one after the other, on a thread of its own, and counts each once nobody can discard it any more.

    Args:
        save: saves a take.
        undo: takes the last back that was saved.
        count: counts one.
    """

    def __init__(
        self, save: Callable[[Episode], None], undo: Callable[[], None], count: Callable[[Episode], None]
    ) -> None:
        self._save, self._undo, self._count = save, undo, count
        self._thread = ThreadPoolExecutor(1, "bhd-save")
        self._last: tuple[Episode, Future[None]] | None = None

    @property
    def last(self) -> Episode | None:
        """The take that can still be discarded."""
        return self._last and self._last[0]

    @property
    def is_saving(self) -> bool:
        """Whether a take is being saved."""
        return self._last is not None and not self._last[1].done()

    def add(self, take: Episode) -> None:
        """Begin to save a take."""
        self.wait()
        self._last = take, self._thread.submit(self._save, take)

    def wait(self) -> None:
        """Wait until the last take is saved; it stays.

        Raises:
            BhdError: it could not be saved.
        """
        if self._last is not None:
            (take, saved), self._last = self._last, None
            saved.result()
            self._count(take)

    def discard(self) -> None:
        """Take the last take back."""
        if self._last is not None:
            (_, saved), self._last = self._last, None
            saved.result()
            self._undo()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown()
        if error is None:
            self.wait()
