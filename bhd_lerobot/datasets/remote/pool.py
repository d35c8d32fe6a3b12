"""Many files at once, in threads."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

WORKERS = 4
"""Files that are moved at a time, while the checksums of others are made. With more of them the threads of a fast
connection mostly wait for each other: 8 are slower than 4 on 2 cores."""


def run_all[T](work: Callable[[T], None], items: Sequence[T], workers: int = WORKERS) -> None:
    """Do something for every item, in threads.

    Those that are under way when one fails come to their end; no other is begun.

    Raises:
        Exception: of the first that failed.
    """
    stopped = threading.Event()

    def one(item: T) -> None:
        if not stopped.is_set():
            work(item)

    with ThreadPoolExecutor(max(1, min(workers, len(items)))) as pool:
        try:
            for future in as_completed([pool.submit(one, item) for item in items]):
                future.result()
        finally:
            stopped.set()
