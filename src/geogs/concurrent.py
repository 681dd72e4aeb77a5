"""Work in other threads than the one that frames come to."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager


class BackgroundTask:
    """One piece of work at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        """``name`` is the thread's."""
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
        """Wait until the work is done; raises what it has raised, once."""
        work, self._work = self._work, None
        if work is not None:
            work.result()


class PriorityGate:
    """Lets short work that is urgent go before long work of another thread."""

    def __init__(self, longest: float) -> None:
        """``longest``: seconds for which the long work waits at a time."""
        self._longest = longest
        self._is_free = threading.Event()
        self._is_free.set()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """While urgent work is going on."""
        self._is_free.clear()
        try:
            yield
        finally:
            self._is_free.set()

    def give(self) -> None:
        """Wait until nothing is urgent; called between two parts of the long work."""
        self._is_free.wait(self._longest)
