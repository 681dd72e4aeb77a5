"""Ctrl-C as a request: the work stops at the next safe point and keeps what there is."""

import signal
import threading
from types import FrameType


class Interruption:
    """While it is entered, the first Ctrl-C only sets ``requested``; the second quits."""

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> "Interruption":
        # Python takes signals in the main thread alone.
        self._is_listening = threading.current_thread() is threading.main_thread()
        if self._is_listening:
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._is_listening:
            signal.signal(signal.SIGINT, self._before)

    def check(self) -> None:
        """A safe point inside a long stage: raises KeyboardInterrupt after a request."""
        if self.requested:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.check()
        self.requested = True
