"""Ctrl-C and SIGTERM as a request: work stops at the next safe point and keeps what there is."""

import signal
import threading
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """A request to stop; nobody makes this one. It may be entered again and again."""

    requested = False

    def __enter__(self) -> "Stop":
        self.requested = False
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def request(self) -> None:
        """Ask to stop."""
        self.requested = True

    def check(self) -> None:
        """A safe point inside a long stage: raises KeyboardInterrupt after a request."""
        if self.requested:
            raise KeyboardInterrupt

    def lets_finish(self, work: Callable[[], object]) -> bool:
        """Do some work; false where a request to stop ended it at a safe point."""
        try:
            work()
        except KeyboardInterrupt:
            if not self.requested:
                raise
            return False
        return True


class Interruption(Stop):
    """While it is entered, the first Ctrl-C only sets ``requested``; the second quits.

    SIGTERM, by which systems and schedulers end programs, is the same.
    """

    def __enter__(self) -> "Interruption":
        super().__enter__()
        # Python takes signals in the main thread alone.
        self._is_listening = threading.current_thread() is threading.main_thread()
        if self._is_listening:
            self._before = {n: signal.signal(n, self._handle) for n in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        if self._is_listening:
            for number, before in self._before.items():
                signal.signal(number, before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.check()
        self.requested = True
