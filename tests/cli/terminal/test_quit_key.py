"""The key that ends a live run."""

import io
import os
import threading

import pytest

from geogs.cli.run import quit_key

pty = pytest.importorskip("pty")


class Terminal:
    """Standard input that is a terminal."""

    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number


def test_q_stops_and_the_terminal_is_as_it_was(monkeypatch):
    import termios

    outside, inside = pty.openpty()
    monkeypatch.setattr("sys.stdin", Terminal(inside))
    before, stopped = termios.tcgetattr(inside), threading.Event()
    with quit_key(stopped.set) as is_heard:
        assert is_heard
        os.write(outside, b"x")
        assert not stopped.wait(0.3)
        os.write(outside, b"q")
        assert stopped.wait(5)
    assert termios.tcgetattr(inside) == before
    os.close(outside)
    os.close(inside)


def test_without_a_terminal_no_key_is_heard(monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with quit_key(lambda: None) as is_heard:
        assert not is_heard
