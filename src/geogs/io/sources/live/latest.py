"""Of items that come at their own pace, always the newest: what is not taken in time is gone."""

import threading
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Takes items from an iterator in a thread, and holds no more than the last of them."""

    def __init__(self, items: Iterator[T]) -> None:
        self._items = items
        self._news = threading.Condition()
        self._held: list[T] = []
        self._has_ended = self._is_closed = False
        self._failure: Exception | None = None
        self.dropped = 0
        """Items that another took the place of before anybody wanted them."""
        self._thread = threading.Thread(target=self._work, name="grabber", daemon=True)
        self._thread.start()

    def take(self) -> T | None:
        """The newest item that was not taken, waiting for one if need be; none after the last.

        Raises what the iterator raised, once all it gave is taken.
        """
        with self._news:
            while not (self._held or self._has_ended):
                self._news.wait(0.2)  # so that signals are heard
            if self._held:
                return self._held.pop()
            if self._failure is not None:
                raise self._failure
            return None

    def close(self, patience: float = 2.0) -> None:
        """Take no more; waits so many seconds at most for the iterator to end."""
        self._is_closed = True
        self._thread.join(patience)

    def _work(self) -> None:
        try:
            for item in self._items:
                if self._is_closed:
                    break
                with self._news:
                    self.dropped += len(self._held)
                    self._held = [item]
                    self._news.notify()
        except Exception as error:
            self._failure = error
        finally:
            close = getattr(self._items, "close", None)
            if close is not None:
                close()
            with self._news:
                self._has_ended = True
                self._news.notify()
