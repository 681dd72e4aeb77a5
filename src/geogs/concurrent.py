"""Work in other threads than that of the frames."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager


class BackgroundTask:
    """One piece of work at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        """``name``: name of the thread."""
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._work: Future[None] | None = None

    @property
    def is_going_on(self) -> bool:
        """Whether the work started last is not done yet."""
        return self._work is not None and not self._work.done()

    def start(self, work: Callable[[], None]) -> None:
        """Begin a piece of work, once the one before is done."""
        self.wait()
        self._work = self._thread.submit(work)

    def wait(self) -> None:
        """Wait until the work is done; re-raises its exception once."""
        work = self._work
        self._work = None
        if work is not None:
            work.result()


class PriorityGate:
    """Lets short urgent work go before long work of another thread."""

    def __init__(self, longest: float) -> None:
        """``longest``: longest wait of the long work at a time, seconds."""
        self._longest = longest
        self._is_free = threading.Event()
        self._is_free.set()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Context of urgent work."""
        self._is_free.clear()
        try:
            yield
        finally:
            self._is_free.set()

    def give(self) -> None:
        """Wait for urgent work; called between two parts of the long work."""
        self._is_free.wait(self._longest)
