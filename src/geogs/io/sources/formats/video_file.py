"""Video files through FFmpeg (PyAV), with the container's own time stamps."""

import itertools
import logging
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from jaxtyping import UInt8

from geogs.errors import InputError
from geogs.guard.documents import require_file
from geogs.io.pictures import most_pixels
from geogs.io.sources.account import Account
from geogs.io.sources.reader import RawFrame, RecordingInfo, size_of
from geogs.io.sources.video_limits import check_decodable, nominal_rate, video_formats

_OPTIONS = {
    "protocol_whitelist": "file",  # no container may lead to the network
    "format_whitelist": video_formats(),
}

_log = logging.getLogger(__name__)

MOST_ASPECT = 4.0
"""Largest ratio of the sides of a pixel that is believed."""


class VideoFile:
    """Reader of one video; frames are shown as the container's display matrix says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with _open(path) as container:
            stream = container.streams.video[0]
            first = next(filter(None, _decoded(container, path)), None)
            if first is None:
                raise InputError(
                    f"{path} holds no picture that can be decoded; is it complete and a video?"
                )
            self._is_mirrored, turns = display_turn(first)
            aspect = _pixel_aspect(stream, turns)
            width, height = (first.width, first.height)[:: -1 if turns % 2 else 1]
            self.info = RecordingInfo(
                "video",
                path.name,
                width,
                height,
                fps=nominal_rate(stream.average_rate or stream.guessed_rate, least=1e-3),
                length=stream.frames or None,
                quarter_turns=turns,
                seconds=_seconds(container),
                pixel_aspect=aspect,
                account=_account(self._is_mirrored, aspect),
            )

    @property
    def paths(self) -> list[Path]:
        """The file that is read."""
        return [self._path]

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Decode from the beginning and yield frames ``start, start + stride, ...``."""
        last: float | None = None
        with _open(self._path) as container:
            for index, frame in enumerate(_decoded(container, self._path)):
                if stop is not None and index >= stop:
                    return
                last = last if frame is None else self._time(frame, last)
                if index >= start and (index - start) % stride == 0:
                    label = f"{self.info.name}, frame {index}"
                    image = None if frame is None else self._shown(frame)
                    yield RawFrame(label, last or 0.0, image, name=str(index))

    def spread(self, starts: Sequence[int]) -> Iterator[RawFrame]:
        """Read the images where decoding of these frames starts; fewer where it cannot seek."""
        with _open(self._path) as container:
            stream = container.streams.video[0]
            before = -1
            first = stream.start_time or 0
            for start in starts:
                try:
                    time = round(start / self.info.fps / float(stream.time_base or 1))
                    container.seek(first + time, stream=stream)
                    frame = next(container.decode(stream), None)
                except av.error.FFmpegError:
                    continue
                if frame is None or frame.pts is None or frame.pts == before:
                    continue
                before = frame.pts
                near = f"{self.info.name}, near frame {start}"
                yield RawFrame(near, frame.time or 0.0, self._shown(frame))

    def _shown(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image as a player shows it."""
        image = frame.to_ndarray(format="rgb24")
        return turn_upright(image[:, ::-1] if self._is_mirrored else image, self.info.quarter_turns)

    def _time(self, frame: av.VideoFrame, last: float | None) -> float:
        """Presentation time, or an estimate where it is missing or does not increase."""
        if frame.time is not None and (last is None or frame.time > last):
            return frame.time
        return 0.0 if last is None else last + 1 / self.info.fps


def display_turn(frame: av.VideoFrame) -> tuple[bool, int]:
    """Whether a frame is to be mirrored left to right, and then its clockwise quarter turns.

    Its display matrix takes a stored position (x, y) to (a x + c y, b x + d y), y down.
    """
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return False, 0
    a, b, _, c, d = struct.unpack_from("=5i", bytes(matrix))
    is_mirrored = a * d - b * c < 0
    sign = -1 if is_mirrored else 1
    angle = math.atan2(sign * b, sign * a)
    return is_mirrored, round(angle / (math.pi / 2)) % 4


def _pixel_aspect(stream: Any, quarter_turns: int) -> float:
    """Width by height of a pixel of the upright images; 1 where the container does not say."""
    said = stream.sample_aspect_ratio
    stored = float(said) if said else 1.0
    if not 1 / MOST_ASPECT <= stored <= MOST_ASPECT:
        return 1.0
    return 1 / stored if quarter_turns % 2 else stored


def _account(is_mirrored: bool, pixel_aspect: float) -> Account:
    """Sentences on the container's display matrix and the shape of pixels."""
    said = []
    if pixel_aspect != 1:
        said.append(f"pixels are {pixel_aspect:.4g} times as wide as high, by the video file")
    if is_mirrored:
        said.append("images are mirrored, as a player shows them, by the video file")
    return Account(tuple(said))


def turn_upright(
    image: UInt8[np.ndarray, "h w 3"], quarter_turns: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Turn an image by clockwise quarter turns."""
    return np.ascontiguousarray(np.rot90(image, -quarter_turns))


def _seconds(container: InputContainer) -> float | None:
    """Time of the last image by the stream, or else by the container."""
    stream = container.streams.video[0]
    if stream.duration is not None and stream.time_base is not None:
        return float(((stream.start_time or 0) + stream.duration) * stream.time_base)
    return None if container.duration is None else container.duration / av.time_base


def _container(path: Path) -> InputContainer:
    try:
        return av.open(str(path), metadata_errors="replace", options=_OPTIONS)
    except TypeError:  # PyAV 19 no longer has it
        return av.open(str(path), options=_OPTIONS)


def _open(path: Path) -> InputContainer:
    try:
        container = _container(require_file(path))
    except av.error.ArgumentError as error:  # a format that is not on the list
        raise InputError(f"{path} is no video; give a video file or a folder of images.") from error
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(
            f"{path} cannot be opened as a video ({error.strerror}); "
            f"is it complete and a video file?"
        ) from error
    is_picture = container.format.name.endswith("_pipe")
    if is_picture or not container.streams.video:
        container.close()
        what = "a single picture" if is_picture else "no video"
        raise InputError(f"{path} is {what}; give a video file or a folder of images.")
    check_decodable(container, str(path), most_pixels(size_of(path) or 0))
    return container


def _decoded(container: InputContainer, path: Path) -> Iterator[av.VideoFrame | None]:
    """Decode to the end or to where the file is cut off; none stands for a damaged packet."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    count = 0
    shown = -math.inf
    latest = -math.inf
    for packet in _packets(container, path):
        if packet.pts is not None and not packet.is_discard:
            latest = max(latest, packet.pts)
        try:
            frames: list[av.VideoFrame | None] = list(packet.decode())
        except av.error.FFmpegError:
            frames = [None]
        for frame in frames:
            count += 1
            if frame is not None and frame.pts is not None:
                shown = max(shown, frame.pts)
            yield None if frame is None or frame.is_corrupt else frame
    # Frames left in the threads come in one call at the end, which a damaged packet cuts short.
    if shown < latest and stream.codec_context.thread_count != 1:
        with _open(path) as again:
            again.streams.video[0].codec_context.thread_count = 1
            yield from itertools.islice(_decoded(again, path), count, None)


def _packets(container: InputContainer, path: Path) -> Iterator["av.Packet[Any]"]:
    """Packets to the end, with the empty last one, or to the cut of a damaged file."""
    try:
        yield from container.demux(container.streams.video[0])
    except av.error.FFmpegError as error:
        _log.warning("%s is damaged or cut off (%s).", path, error.strerror)
