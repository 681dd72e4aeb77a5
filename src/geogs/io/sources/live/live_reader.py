"""A reader of live frames: it yields the newest, and counts dropped ones."""

import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from geogs.io.sources.reader import RawFrame, RecordingInfo

T = TypeVar("T")


@runtime_checkable
class Feed(Protocol):
    """A source of frames that come at their own pace."""

    info: RecordingInfo

    def frames(self) -> Generator[RawFrame, None, None]:
        """Yield frames from now on; blocks until each arrives."""
        ...


class LiveReader:
    """Reader of a feed: at most one frame waits, older ones are dropped and counted."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.info = feed.info
        self.dropped = 0
        """Frames of the last reading that came too fast to be used."""

    @property
    def paths(self) -> Sequence[Path]:
        """No file is read."""
        return ()

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read the newest of frames ``start, start + stride, ...`` before ``stop`` each time."""
        latest = Latest(_selected(self._feed.frames(), start, stop, stride))
        try:
            while (frame := latest.take()) is not None:
                self.dropped = latest.dropped
                yield frame
        finally:
            latest.close()


def _selected(
    frames: Generator[RawFrame, None, None], start: int, stop: int | None, stride: int
) -> Iterator[RawFrame]:
    with closing(frames):
        yield from islice(frames, start, stop, stride)


class Latest(Generic[T]):
    """The newest item of an iterator, which runs in a thread; items not taken in time are
    dropped."""

    def __init__(self, items: Iterator[T]) -> None:
        self._items = items
        self._news = threading.Condition()
        self._held: list[T] = []
        self._has_ended = self._is_closed = False
        self._failure: Exception | None = None
        self.dropped = 0
        """Number of items replaced before they were taken."""
        self._thread = threading.Thread(target=self._work, name="grabber", daemon=True)
        self._thread.start()

    def take(self) -> T | None:
        """Return the newest item not yet taken, or wait for one; none after the last.

        Raises the iterator's exception, once its items are taken.
        """
        with self._news:
            while not (self._held or self._has_ended):
                self._news.wait(0.2)  # so that signals are handled
            if self._held:
                return self._held.pop()
            if self._failure is not None:
                raise self._failure
            return None

    def close(self, patience: float = 2.0) -> None:
        """Stop; wait at most ``patience`` seconds for the iterator to end."""
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
