"""``geogs view OUT``: look at a result in the browser."""

import time
from collections.abc import Sequence

from geogs.application.result_settings import ViewSettings
from geogs.cli.options import parse_options
from geogs.guard.terminal_text import say


def main(argv: Sequence[str]) -> int:
    """Run the command until Ctrl-C; returns the exit code."""
    options = parse_options(ViewSettings, argv, "view")

    from geogs.application.results.saved_result import load_result
    from geogs.application.viewer.saved import open_window

    window = open_window(load_result(options.result), options.host, options.port)
    say(f"Open {window.address} in a browser; Ctrl-C ends.")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        window.stop()
    return 0
