"""Commands called in the process of the tests, for results that several of them read."""

import contextlib
import io

import pytest

from geogs.cli.main import main


def done(*arguments: object, report: bool = True) -> str:
    """Standard error of a command, which has to come to its end, with a reliable result or not.

    Without ``report`` its result comes without the pictures of the report, which take longer than
    a small run.
    """
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(said):
        if not report:
            for part in ("write_page", "write_pictures"):
                patch.setattr(f"geogs.application.results.write.{part}", lambda *_: None)
        with contextlib.redirect_stdout(io.StringIO()):
            code = main([str(a) for a in arguments])
    assert code in (0, 3), said.getvalue()
    return said.getvalue()
