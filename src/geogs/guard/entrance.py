"""Who may change a system, and when: one thread of the process that made it, whole images only."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import FrameType
from typing import ParamSpec, TypeVar

from geogs.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


class Entrance:
    """Refuses calls that would leave a system half changed, or wait for threads for ever."""

    def __init__(self) -> None:
        self._process = os.getpid()
        self._lock = threading.RLock()
        self._is_unfinished = False

    def require_process(self) -> None:
        """Raise InputError in another process than that in which the system was made."""
        if os.getpid() != self._process:
            raise InputError(
                "This system was made before the process was forked, and its threads stayed "
                "behind; make it in the new process, or start that by multiprocessing's spawn."
            )

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Context of a change.

        Raises:
            InputError: another thread is changing the system, or another process made it.
        """
        self.require_process()
        if not self._lock.acquire(blocking=False):
            raise InputError("Another thread is at work in this system; wait until it is done.")
        try:
            yield
        finally:
            self._lock.release()

    @contextmanager
    def image(self) -> Iterator[None]:
        """Context of the processing of an image; Ctrl-C waits for its end, a second one does not.

        Raises:
            InputError: the processing of an earlier image was cut off.
        """
        if self._is_unfinished:
            raise InputError(
                "The image before was cut off by an error or an interruption, and none can follow "
                "it; finish() or save what there is, and begin anew."
            )
        self._is_unfinished = True
        with _held_interrupt():
            yield
            self._is_unfinished = False


def changes_system(method: Callable[P, R]) -> Callable[P, R]:
    """Let a method of an object with an ``entrance`` be entered by that alone."""

    @wraps(method)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        entrance: Entrance = args[0].entrance  # type: ignore[attr-defined]
        with entrance.entered():
            return method(*args, **kwargs)

    return wrapped


@contextmanager
def _held_interrupt() -> Iterator[None]:
    """Raise the KeyboardInterrupt of Python's own handler after the block, at a second Ctrl-C in
    it. Handlers of programs are left alone."""
    usual = signal.default_int_handler
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not usual:
        yield
        return
    has_come = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal has_come
        if has_come:
            raise KeyboardInterrupt
        has_come = True

    signal.signal(signal.SIGINT, hold)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
        if has_come:
            raise KeyboardInterrupt
