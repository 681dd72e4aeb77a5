"""The key q, which ends a live run like Ctrl-C."""

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PAUSE = 0.2
"""Interval of checks whether to stop listening, in seconds."""


@contextmanager
def quit_key(stop: Callable[[], None]) -> Iterator[bool]:
    """Call ``stop`` when q is pressed in the block; yields whether keys can be read.

    They cannot if standard input is no terminal. Its mode is restored afterwards.
    """
    try:
        keys = sys.stdin.fileno()
        before = termios.tcgetattr(keys)
    except (AttributeError, OSError, ValueError, termios.error):
        yield False
        return
    ended = threading.Event()

    def listen() -> None:
        while not ended.is_set():
            if select.select([keys], [], [], PAUSE)[0] and os.read(keys, 1) in (b"q", b"Q"):
                stop()
                return

    thread = threading.Thread(target=listen, name="keys", daemon=True)
    tty.setcbreak(keys)
    thread.start()
    try:
        yield True
    finally:
        ended.set()
        thread.join()
        termios.tcsetattr(keys, termios.TCSADRAIN, before)
