"""A file that plays at its pace, as a camera would: for rehearsals."""

import time
from collections.abc import Generator

from geogs.io.sources.base import RawFrame, Reader


class Played:
    """The frames of another reader, none before its time has come."""

    kind = "play"

    def __init__(self, reader: Reader, name: str) -> None:
        self._reader = reader
        self.name = name
        self.width, self.height, self.fps = reader.width, reader.height, reader.fps
        self.calibration = reader.calibration

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
