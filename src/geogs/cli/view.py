"""``geogs view OUT``: look at a result in the browser."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from geogs.application.viewer.settings import ViewSettings
from geogs.cli.options import parse_options


@dataclass(frozen=True)
class ViewOptions(ViewSettings):
    """Look at a result in the browser: mesh, disks, path, keyframes with depth and normals.

    Needs pip install 'geogs[viewer]'; without it, open report/index.html of the result. Over ssh:
    ssh -L 8080:localhost:8080 MACHINE, then http://localhost:8080 on your own machine.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command until Ctrl-C; returns the exit code."""
    options = parse_options(ViewOptions, argv, "view")

    from geogs.application.results.saved_result import load_result
    from geogs.application.viewer.saved import open_window

    window = open_window(load_result(options.result), options.host, options.port)
    print(f"Open {window.address} in a browser; Ctrl-C ends.", flush=True)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        window.stop()
    return 0
