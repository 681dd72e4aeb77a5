"""Open live sources: a camera, a stream, a pipe, or a file played at its pace."""

import sys
import time
from collections.abc import Generator
from io import BufferedIOBase
from pathlib import Path
from typing import cast

from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.live.capture import Capture
from geogs.io.sources.live.live_reader import LiveReader
from geogs.io.sources.live.network_stream import NetworkStream
from geogs.io.sources.live.pipe import Pipe
from geogs.io.sources.reader import RawFrame, Reader, RecordingInfo


def open_live(address: LiveAddress, pipe: str, played: Reader | None = None) -> LiveReader:
    """A reader of a camera, a stream, standard input or a file that is ``played``.

    ``pipe`` is the format of raw frames, see :class:`Pipe`. Raises InputError if it cannot be.
    """
    if address.kind == "play":
        assert played is not None, "who plays a file has opened it"
        return LiveReader(Played(played, Path(address.target).name))
    if address.kind != "pipe":
        is_camera = address.kind == "camera"
        return LiveReader(Capture(address) if is_camera else NetworkStream(address))
    if sys.stdin is None or sys.stdin.isatty():
        raise InputError("- reads raw frames from a pipe, and nothing is piped in.")
    return LiveReader(Pipe(cast(BufferedIOBase, sys.stdin.buffer), pipe))


class Played:
    """The frames of another reader in real time: a simulated camera."""

    def __init__(self, reader: Reader, name: str) -> None:
        self._reader = reader
        said = reader.info
        self.info = RecordingInfo(
            "play",
            name,
            said.width,
            said.height,
            said.fps,
            calibration=said.calibration,
            pixel_aspect=said.pixel_aspect,
            account=said.account,
        )

    def frames(self) -> Generator[RawFrame, None, None]:
        """Frames from the first on, by their time stamps."""
        began: float | None = None
        for raw in self._reader.read(0, None, 1):
            now = time.monotonic()
            if began is None:
                began = now - raw.timestamp
            wait = began + raw.timestamp - now
            if wait > 0:
                time.sleep(wait)
            yield raw
