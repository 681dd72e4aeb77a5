"""Open what does not wait."""

import sys
from io import BufferedIOBase
from pathlib import Path
from typing import cast

from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.base import Reader
from geogs.io.sources.live.capture import Capture
from geogs.io.sources.live.pipe import Pipe
from geogs.io.sources.live.played import Played
from geogs.io.sources.live.reader import LiveReader


def open_live(address: LiveAddress, pipe: str, played: Reader | None = None) -> LiveReader:
    """A reader of a camera, a stream, standard input or a file that is ``played``.

    ``pipe`` is the format of raw frames, see :class:`Pipe`. Raises InputError if it cannot be.
    """
    if address.kind == "play":
        assert played is not None, "who plays a file has opened it"
        return LiveReader(Played(played, Path(address.target).name))
    if address.kind != "pipe":
        return LiveReader(Capture(address))
    if sys.stdin is None or sys.stdin.isatty():
        raise InputError("- reads raw frames from a pipe, and nothing is piped in.")
    return LiveReader(Pipe(cast(BufferedIOBase, sys.stdin.buffer), pipe))
