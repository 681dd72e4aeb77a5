"""A reader of frames that do not wait: whoever is late gets the newest, and the rest is counted."""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from geogs.io.sources.base import RawFrame
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.live.latest import Latest


@runtime_checkable
class Feed(Protocol):
    """Where frames come from at their own pace."""

    kind: str
    name: str
    width: int
    """Of the upright images, pixels."""
    height: int
    fps: float
    """Frames per second, nominal."""
    calibration: Calibration | None
    """The camera as far as the feed says."""

    def frames(self) -> Generator[RawFrame, None, None]:
        """Frames from now on; each is waited for."""
        ...


@dataclass(frozen=True)
class Numbered:
    """A frame and its place in the feed."""

    position: int
    frame: RawFrame


class LiveReader:
    """Reader of a feed: at most one frame waits, older ones are dropped and counted."""

    is_live = True
    quarter_turns = 0
    has_depth = False
    length: int | None = None

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self.kind, self.name = feed.kind, feed.name
        self.width, self.height, self.fps = feed.width, feed.height, feed.fps
        self.calibration = feed.calibration
        self.dropped = 0
        """Frames of the last reading that came too fast to be used."""

    @property
    def paths(self) -> Sequence[Path]:
        """No file is read."""
        return ()

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Of frames ``start, start + stride, ...`` before ``stop`` the newest each time."""
        latest = Latest(_selected(self._feed.frames(), start, stop, stride))
        try:
            while (numbered := latest.take()) is not None:
                self.dropped = latest.dropped
                yield numbered.frame
        finally:
            latest.close()


def _selected(
    frames: Generator[RawFrame, None, None], start: int, stop: int | None, stride: int
) -> Iterator[Numbered]:
    try:
        for position, frame in enumerate(frames):
            if stop is not None and position >= stop:
                return
            if position >= start and (position - start) % stride == 0:
                yield Numbered(position, frame)
    finally:
        frames.close()
