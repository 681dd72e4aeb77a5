"""What a command says before there is any news."""

import io
import sys

import pytest

from geogs.application.run_settings import Verbosity
from geogs.cli.terminal.speech import say_loading


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "quiet", "said"),
    [(Terminal(), False, "loading ...\r"), (Terminal(), True, ""), (io.StringIO(), False, "")],
)
def test_a_terminal_is_told_at_once_that_it_begins(monkeypatch, stream, quiet, said):
    monkeypatch.setattr(sys, "stderr", stream)
    say_loading(Verbosity(quiet=quiet))
    assert stream.getvalue() == said
