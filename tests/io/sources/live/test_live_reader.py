"""Sources that do not wait, opened as all others are."""

import io
import time

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.frame_source import Source
from geogs.io.sources.live.feeds import Played
from geogs.io.sources.live.live_reader import LiveReader
from geogs.io.sources.live.pipe import Pipe
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.io.sources.sniff import open_source
from geogs.io.sources.working_images import WorkingImages

SECONDS = 0.02


class Clip:
    """Twelve images of their own number, one in ``SECONDS``."""

    info, paths = RecordingInfo("clip", "clip", 64, 48, 1 / SECONDS, 12), ()
    asked = 0
    """Number of the image that was asked for last."""

    def read(self, start, stop, stride):
        for n in range(start, 12 if stop is None else stop, stride):
            self.asked = n
            yield RawFrame(str(n), 5 + SECONDS * n, np.full((48, 64, 3), 10 * n, np.uint8))


def played(config=None, clip=None):
    reader = LiveReader(Played(clip or Clip(), "clip"))
    return Source([WorkingImages(reader, config or InputConfig())])


def test_a_file_plays_at_its_pace_and_nothing_waits_for_who_is_late():
    clip = Clip()
    source = played(clip=clip)
    assert source.is_live
    assert not source.is_shutter_open
    assert source.length is None
    assert source
    with pytest.raises(TypeError, match="not known beforehand"):
        len(source)
    began, seen = time.monotonic(), []
    for frame in source:
        seen.append((frame.index, round(frame.image.mean() / 10), frame.timestamp))
        if len(seen) == 1:
            while clip.asked < min(seen[0][1] + 5, 11):
                time.sleep(SECONDS / 10)
    assert time.monotonic() - began >= 10.5 * SECONDS
    index, number, seconds = map(list, zip(*seen, strict=True))
    assert index == [*range(len(seen))]
    assert number == sorted(set(number))
    assert number[-1] == 11
    assert source.dropped == 12 - len(seen) >= 3
    assert number[1] >= min(number[0] + 4, 11)
    assert seconds == pytest.approx([5 + SECONDS * n for n in number])


def test_start_stop_and_stride_count_what_came():
    source = played(InputConfig(start=2, stop=9, stride=3))
    numbers = [round(frame.image.mean() / 10) for frame in source]
    assert set(numbers) <= {2, 5, 8}
    assert numbers[-1] == 8


def test_a_pipe_is_read_on_where_it_is():
    data = np.repeat(np.arange(8, dtype=np.uint8) * 10, 64 * 48 * 3).tobytes()
    reader = LiveReader(Pipe(io.BytesIO(data), "64x48:rgb24"))
    first = next(reader.read(0, None, 1))
    assert first.image.shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("start", "size", "said"),
    [
        (0, 0, "pipe ended before its first image."),
        (0, 48 * 64, "pipe ended before its first image."),
        (5, 3 * 48 * 64, "pipe ends before frame 5; give a smaller start."),
    ],
)
def test_a_pipe_that_ends_too_early_is_told_apart_from_a_start_that_is_too_late(start, size, said):
    reader = LiveReader(Pipe(io.BytesIO(bytes(size)), "64x48:rgb24"))
    with pytest.raises(InputError) as refused:
        next(iter(Source([WorkingImages(reader, InputConfig(start=start))])))
    assert str(refused.value) == said


def test_what_cannot_be_opened_ends_in_a_sentence(monkeypatch, tmp_path, capfd):
    with pytest.raises(InputError, match=r"camera-99 cannot be opened; is it plugged in"):
        open_source("camera:99")
    with pytest.raises(InputError, match=r"stream-127\.0\.0\.1-1 cannot be opened"):
        open_source("rtsp://user:secret@127.0.0.1:1/x")
    with pytest.raises(InputError, match="does not exist"):
        open_source(f"play:{tmp_path}/none.mp4")
    with pytest.raises(InputError, match="read alone"):
        open_source(["camera:0", tmp_path])
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(InputError, match="nothing is piped in"):
        open_source("-")
