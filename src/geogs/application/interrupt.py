"""Signals as a request to stop: work does at the next safe point, and keeps what there is."""

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask to stop: of a terminal, of schedulers, of a terminal that is gone."""
_RETRY_SECONDS = 0.02
"""Seconds until it is looked again whether modules are still being imported."""
_MAX_IMPORT_SECONDS = 5.0
"""Seconds after which an import that was asked to end counts as hanging."""


def handled_signals() -> list[signal.Signals]:
    """The ``SIGNALS`` that nobody has asked to be ignored, as nohup and shells in scripts do."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handler of a signal: raises KeyboardInterrupt, in an import as soon as that is done.

    A module of which an exception has left one half makes others fail with anything. Another signal
    in an import ends the process where that seems to hang, and changes nothing before: an end at
    once would leave behind what was begun, such as an empty folder.
    """
    is_waiting, left = signal.getitimer(signal.ITIMER_REAL)
    if not _is_importing(frame):
        signal.setitimer(signal.ITIMER_REAL, 0)
        raise KeyboardInterrupt
    # The timer's interval, which is never reached, is what is left of the patience.
    left = max(left - _RETRY_SECONDS, _RETRY_SECONDS) if is_waiting or left else _MAX_IMPORT_SECONDS
    if number in SIGNALS and left <= _RETRY_SECONDS:
        os._exit(128 + number)
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, _RETRY_SECONDS, left)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


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

    SIGTERM, by which systems and schedulers end programs, is the same, and so is SIGHUP, which a
    terminal leaves behind. What is ignored stays so.
    """

    def __enter__(self) -> "Interruption":
        super().__enter__()
        # Python takes signals in the main thread alone.
        self._is_listening = threading.current_thread() is threading.main_thread()
        if self._is_listening:
            self._before = {n: signal.signal(n, self._handle) for n in handled_signals()}
        return self

    def __exit__(self, *exception: object) -> None:
        if self._is_listening:
            for number, before in self._before.items():
                signal.signal(number, before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            interrupt(number, frame)
        self.requested = True
