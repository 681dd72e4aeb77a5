"""Clips of neighbouring images from all over a source, which tell its shutter's readout."""

from collections.abc import Callable, Generator

from geogs.config import InputConfig
from geogs.io.sources.reader import RawFrame, Reader, read_side_by_side
from geogs.shutter.readout import CLIP, CLIPS

MINUTE = 60.0
"""Seconds of a video that are looked at for its readout."""


def read_clips(
    reader: Reader, config: InputConfig, resized: Callable[[RawFrame], RawFrame]
) -> Generator[list[RawFrame], None, None]:
    """Neighbouring images of the selection, ``resized``; the stride does not count.

    They are as many as tell the readout. A video can only be read from its beginning on, so that
    they come from its first minute.
    """
    ends = [n for n in (config.stop, reader.info.length) if n is not None]
    count = min(ends) - config.start if ends else CLIP * CLIPS
    if len(reader.paths) > 1:
        starts = clip_starts(config.start, count)
        yield from read_side_by_side(
            lambda n: list(map(resized, reader.read(n, n + CLIP, 1))), starts
        )
        return
    starts = clip_starts(config.start, min(count, round(MINUTE * reader.info.fps)))
    if not starts:
        return
    clip: list[RawFrame] = []
    raws = reader.read(starts[0], starts[-1] + CLIP, 1)
    for position, raw in enumerate(raws, starts[0]):
        if any(start <= position < start + CLIP for start in starts):
            clip.append(resized(raw))
        if position - CLIP + 1 in starts:
            yield clip[-CLIP:]
        del clip[:-CLIP]


def clip_starts(first: int, count: int) -> list[int]:
    """Where clips begin that spread over ``count`` images from ``first`` on.

    Those of a short video overlap by half.
    """
    clips = min(CLIPS, max(0, count - CLIP // 2) // (CLIP - CLIP // 2))
    return [first + round(k * (count - CLIP) / max(clips - 1, 1)) for k in range(clips)]
