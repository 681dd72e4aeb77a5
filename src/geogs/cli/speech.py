"""What a command says while it works and at its end."""

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from geogs.application.verbosity import Verbosity
from geogs.cli.options import record

if TYPE_CHECKING:
    from geogs.application.progress import RunProgress
    from geogs.application.results.result import Written


def followed(options: Verbosity, work: Callable[["RunProgress"], "Written"]) -> "Written":
    """Do the work of a command, with a line of progress on the standard error, and say at its end
    on the standard output what came of it."""
    from geogs.application.last_words import last_words
    from geogs.application.terminal import TerminalProgress

    begin = time.perf_counter()
    if options.verbose:
        logging.getLogger("geogs").setLevel(logging.INFO)
        for handler in logging.getLogger("geogs").handlers:
            handler.setLevel(logging.INFO)
            handler.setFormatter(logging.Formatter("%(message)s"))
    with TerminalProgress(record(Verbosity, options)) as progress:
        written = work(progress)
        progress.end_phase()
        words = last_words(written, time.perf_counter() - begin)
        progress.note("\n".join(words))
    if not options.quiet:
        print("\n".join(words))
    return written
