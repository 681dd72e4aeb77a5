"""Clips of neighbouring images from all over a source, to estimate its shutter's readout."""

from collections.abc import Callable, Generator

from geogs.camera.shutter.readout import CLIP, CLIPS, LEAST_CLIPS, SPAN
from geogs.config import InputConfig
from geogs.io.sources.reader import RawFrame, Reader, read_side_by_side

MINUTE = 60.0
"""Seconds of a video that are looked at for its readout."""


def read_clips(
    reader: Reader, config: InputConfig, resized: Callable[[RawFrame], RawFrame], first: int = 0
) -> Generator[list[RawFrame], None, None]:
    """Neighbouring images of the selection, ``resized``, from a clip on; the stride does not count.

    A video can only be read from its beginning on: its clips come from the first minute.
    """
    ends = [n for n in (config.stop, reader.info.length) if n is not None]
    clip = min(CLIP, max(1, round(SPAN * reader.info.fps)))
    count = min(ends) - config.start if ends else clip * CLIPS
    # Of a short video clips are shorter, so that there are as many as it takes to believe them.
    clip = min(clip, max(2 * (count // (LEAST_CLIPS + 1)), 1))
    if len(reader.paths) > 1:
        starts = clip_starts(config.start, count, clip)[first:]
        yield from read_side_by_side(
            lambda n: list(map(resized, reader.read(n, n + clip, 1))), starts
        )
        return
    starts = clip_starts(config.start, min(count, round(MINUTE * reader.info.fps)), clip)[first:]
    if not starts:
        return
    images: list[RawFrame] = []
    raws = reader.read(starts[0], starts[-1] + clip, 1)
    for position, raw in enumerate(raws, starts[0]):
        if any(start <= position < start + clip for start in starts):
            images.append(resized(raw))
        if position - clip + 1 in starts:
            yield images[-clip:]
        del images[:-clip]


def clip_starts(first: int, count: int, clip: int) -> list[int]:
    """First images of clips of ``clip`` images that spread over ``count`` images from ``first`` on.

    Those of a short video overlap by half.
    """
    clips = min(CLIPS, max(0, count - clip // 2) // (clip - clip // 2))
    return [first + round(k * (count - clip) / max(clips - 1, 1)) for k in range(clips)]
