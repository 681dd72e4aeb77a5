"""Raw frames from a pipe: YUV4MPEG2, which describes its format, or bare pixels of a given one.

YUV4MPEG2 is a line of header (``YUV4MPEG2 W640 H480 F30:1 C420``), then ``FRAME`` and the planes Y,
Cb and Cr for each frame. Source: the manual page yuv4mpeg(5) of mjpegtools.
"""

import re
import time
from collections.abc import Generator
from dataclasses import dataclass
from io import BufferedIOBase

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs.errors import InputError
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.io.sources.video_limits import MOST_PIXELS

_RAW = re.compile(r"(\d{1,5})x(\d{1,5}):(rgb24|bgr24|gray|yuv420p)(?:@(\d+(?:\.\d+)?))?")
_MAGIC = b"YUV4MPEG2 "
_LONGEST_LINE = 1024
_FORMATS = {"420": "yuv420p", "mono": "gray", "444": "yuv444p"}

_LEVELS = np.arange(256)
_FULL_Y = np.clip(np.rint((_LEVELS - 16) * 255 / 219), 0, 255).astype(np.uint8)
_FULL_C = np.clip(np.rint((_LEVELS - 128) * 255 / 224 + 128), 0, 255).astype(np.uint8)
"""Levels of Y, and of Cb and Cr, in the full range (ITU-R BT.601)."""


@dataclass(frozen=True)
class RawFormat:
    """Format of the frames in a pipe."""

    width: int
    height: int
    pixels: str
    """rgb24, bgr24, gray, yuv420p or yuv444p."""
    fps: float | None
    """Frames per second; none where it is not given, and frames are timed on arrival."""
    has_frame_lines: bool = False
    """Whether a line precedes each frame."""
    is_full_range: bool = False
    """Whether Y goes from 0 to 255 rather than from 16 to 235, and Cb and Cr likewise."""

    @property
    def bytes(self) -> int:
        """Size of a frame."""
        area = self.width * self.height
        half = ((self.width + 1) // 2) * ((self.height + 1) // 2)
        return {"gray": area, "yuv420p": area + 2 * half}.get(self.pixels, 3 * area)


def format_from_words(words: str) -> RawFormat:
    """Read ``WIDTHxHEIGHT:FORMAT[@FPS]``, as in ``640x480:rgb24@30``. Raises InputError."""
    found = _RAW.fullmatch(words.strip())
    if found is None:
        raise InputError(
            f"--input.pipe {words} is no format of raw frames; give it as 640x480:rgb24@30 "
            "(rgb24, bgr24, gray or yuv420p), or send YUV4MPEG2, which needs none."
        )
    fps = None if found[4] is None else float(found[4])
    return _checked(RawFormat(int(found[1]), int(found[2]), found[3], fps))


def format_from_header(line: bytes) -> RawFormat:
    """Read the header of YUV4MPEG2. Raises InputError."""
    said = {word[:1]: word[1:] for word in line.decode("ascii", "replace").split()[1:]}
    numbers = f"{said.get('W')} {said.get('H')} {said.get('F', '0:0')}"
    found = re.fullmatch(r"(\d{1,5}) (\d{1,5}) (\d{1,9}):(\d{1,9})", numbers)
    if found is None:
        raise InputError("The header of the pipe's YUV4MPEG2 is damaged.")
    width, height, images, seconds = map(int, found.groups())
    fps = images / seconds if images and seconds else None
    chroma = said.get("C", "420")
    kind = "420" if chroma in ("420", "420jpeg", "420paldv", "420mpeg2") else chroma
    if kind not in _FORMATS:
        raise InputError(f"The pipe's YUV4MPEG2 is C{chroma[:16]!a}; 420, 444 and mono are read.")
    is_full = b"XCOLORRANGE=FULL" in line
    return _checked(RawFormat(width, height, _FORMATS[kind], fps, True, is_full))


def _checked(form: RawFormat) -> RawFormat:
    has_rate = form.fps is None or 1e-3 <= form.fps <= 1e4
    if not (0 < form.width * form.height <= MOST_PIXELS and has_rate):
        raise InputError("The pipe's frames have no size or rate that there is.")
    return form


class Pipe:
    """Raw frames from a stream of bytes."""

    def __init__(self, stream: BufferedIOBase, given: str = "auto") -> None:
        """``given`` is the format in words, or auto for YUV4MPEG2. Raises InputError."""
        self._stream = stream
        self._number = 0
        if given == "auto":
            line = stream.readline(_LONGEST_LINE)
            if not line.startswith(_MAGIC):
                raise InputError(
                    "The pipe gives no YUV4MPEG2 (as of ffmpeg -f yuv4mpegpipe); for bare pixels "
                    "give their format: --input.pipe 640x480:rgb24@30."
                )
            self._format = format_from_header(line)
        else:
            self._format = format_from_words(given)
        form = self._format
        self.info = RecordingInfo("pipe", "pipe", form.width, form.height, form.fps or 30.0)
        self._began: float | None = None

    def frames(self) -> Generator[RawFrame, None, None]:
        """Frames from the pipe's current position to its end, without an incomplete last one."""
        form = self._format
        while True:
            if form.has_frame_lines and not self._stream.readline(_LONGEST_LINE).startswith(
                b"FRAME"
            ):
                return
            data = self._stream.read(form.bytes)
            if len(data) < form.bytes:
                return
            now = time.monotonic()
            self._began = now if self._began is None else self._began
            seconds = now - self._began if form.fps is None else self._number / form.fps
            label = f"frame {self._number} of the pipe"
            self._number += 1
            yield RawFrame(label, seconds, rgb(form, data))


def rgb(form: RawFormat, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of a frame's bytes."""
    flat = np.frombuffer(data, np.uint8)
    size = (form.height, form.width)
    if form.pixels == "rgb24":
        return flat.reshape(*size, 3).copy()
    if form.pixels == "bgr24":
        return np.ascontiguousarray(flat.reshape(*size, 3)[..., ::-1])
    if form.pixels == "gray":
        return np.repeat(flat.reshape(*size, 1), 3, 2)
    y = flat[: form.width * form.height].reshape(size)
    rest = flat[y.size :]
    if form.pixels == "yuv444p":
        cb, cr = rest.reshape(2, *size)
    else:
        halves = rest.reshape(2, (form.height + 1) // 2, (form.width + 1) // 2)
        cb, cr = (np.repeat(np.repeat(c, 2, 0), 2, 1)[: size[0], : size[1]] for c in halves)
    if not form.is_full_range:
        y = _FULL_Y[y]
        cb = _FULL_C[cb]
        cr = _FULL_C[cr]
    return cv2.cvtColor(np.dstack([y, cr, cb]), cv2.COLOR_YCrCb2RGB)
