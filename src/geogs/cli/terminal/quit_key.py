"""The key q, which ends a live run as Ctrl-C does."""

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PAUSE = 0.2
"""Seconds between two looks at whether anybody listens still."""


@contextmanager
def quit_key(stop: Callable[[], None]) -> Iterator[bool]:
    """While it is entered, ``stop`` is called when q is pressed; gives whether keys can be heard.

    They cannot where standard input is no terminal. It is as it was afterwards.
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
