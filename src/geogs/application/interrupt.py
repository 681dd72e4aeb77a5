"""Signals as requests to stop: work stops at the next safe point, and keeps its results."""

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType

from geogs.errors import InputError, TrackingLost

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals to stop: from a terminal, from schedulers, from a closed terminal."""
_RETRY_SECONDS = 0.02
"""Interval of checks whether modules are still being imported, in seconds."""


def handled_signals() -> list[signal.Signals]:
    """The ``SIGNALS`` that are not ignored; nohup and shells in scripts ignore some."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


class Interrupted(KeyboardInterrupt):
    """The end of a process by a signal."""

    def __init__(self, code: int, *words: object) -> None:
        super().__init__(*words)
        self.code = code
        """Exit code, as in shells: 128 and the number of the signal."""


def interrupt(number: int, frame: FrameType | None, is_retry: bool = False) -> None:
    """Handle a signal: raise Interrupted; during an import, as soon as that is done.

    A half-imported module makes others fail with any error. Another signal during an import ends
    the process only where the import seems to hang: an end at once would leave unfinished work
    behind, such as an empty folder.
    """
    is_waiting, left = signal.getitimer(signal.ITIMER_REAL)
    if not _is_importing(frame):
        signal.setitimer(signal.ITIMER_REAL, 0)
        raise Interrupted(128 + number)
    # The timer's interval, which is never reached, stores the time left for the import.
    # After five seconds an import counts as hanging.
    left = max(left - _RETRY_SECONDS, _RETRY_SECONDS) if is_waiting or left else 5.0
    if not is_retry and left <= _RETRY_SECONDS:
        os._exit(128 + number)
    signal.signal(signal.SIGALRM, lambda _, frame: interrupt(number, frame, is_retry=True))
    signal.setitimer(signal.ITIMER_REAL, _RETRY_SECONDS, left)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


class Stop:
    """A request to stop, which no signal makes here. It may be entered repeatedly."""

    requested = False
    code = 128 + signal.SIGINT
    """Exit code of a command that was stopped."""

    def __enter__(self) -> "Stop":
        self.requested = False
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def request(self) -> None:
        """Request to stop."""
        self.requested = True

    def check(self) -> None:
        """Mark a safe point of a long stage: raises KeyboardInterrupt after a request."""
        if self.requested:
            raise KeyboardInterrupt

    def lets_finish(self, work: Callable[[], object]) -> bool:
        """Do some work. Returns false if a request to stop ended it at a safe point."""
        try:
            work()
        except KeyboardInterrupt:
            if not self.requested:
                raise
            return False
        return True


class Interruption(Stop):
    """Stop request by signals: inside, the first Ctrl-C only sets ``requested``; the second quits.

    SIGTERM, of systems and schedulers, has the same effect, and so has SIGHUP, of a closed
    terminal. Ignored signals stay ignored. What ends the block after a request, at a safe point or
    as too little was read, ends it as Interrupted.
    """

    def __enter__(self) -> "Interruption":
        super().__enter__()
        self.code = Stop.code
        # Python handles signals in the main thread only.
        self._is_listening = threading.current_thread() is threading.main_thread()
        if self._is_listening:
            self._before = {n: signal.signal(n, self._handle) for n in handled_signals()}
        return self

    def __exit__(self, *exception: object) -> None:
        if self._is_listening:
            for number, before in self._before.items():
                signal.signal(number, before)
        error = exception[1]
        # Of a source that was cut off there may be too little to use; that is no fault of it.
        if not self.requested or isinstance(error, Interrupted):
            return
        if isinstance(error, KeyboardInterrupt | InputError | TrackingLost):
            raise Interrupted(self.code, *error.args) from error

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            interrupt(number, frame)
        self.requested = True
        self.code = 128 + number
