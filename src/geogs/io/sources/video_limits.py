"""Limits of what a video states of itself, checked before any image is decoded."""

from fractions import Fraction

import av
from av.container import InputContainer

from geogs.errors import InputError
from geogs.io.pose_files import FRAMES_PER_SECOND

MOST_PIXELS = 1 << 26
"""Most pixels of an image of a video or a stream: 8192 x 8192."""
# FFmpeg also "plays" text, pictures, devices, and play lists, which open the files they name
# before they can be checked; none of them is a video file.
_NOT_VIDEO = (
    "tty image2 image2pipe hls concat concatf dash webm_dash_manifest sdp rtp rtsp sap imf vobsub "
    "lrc srt lavfi avisynth vapoursynth alsa oss fbdev kmsgrab x11grab xcbgrab video4linux2,v4l2"
)


def video_formats(*more: str) -> str:
    """Names of FFmpeg's formats that lead to no other address, and of ``more``, as its option."""
    names = av.formats_available.difference(_NOT_VIDEO.split())
    return ",".join(sorted(names.union(more)))


def nominal_rate(stated: Fraction | float | None, least: float = 1.0) -> float:
    """The frame rate that a file or a device states; 30 where it is less than ``least`` or more
    than any camera's."""
    rate = float(stated or 0)
    return rate if least <= rate <= 1000.0 else FRAMES_PER_SECOND


def check_decodable(container: InputContainer, name: str, most: int = MOST_PIXELS) -> None:
    """Limit the images of a video to ``most`` pixels, or fewer, before any is decoded.

    Raises:
        InputError: there is no decoder, or the images are larger; the container is closed.
    """
    context = container.streams.video[0].codec_context
    most = min(most, MOST_PIXELS)
    fault = ""
    if context is None:
        fault = "cannot be decoded: is it complete? If its codec is rare, convert it to H.264"
    elif context.width * context.height > most:
        size = f"{context.width}x{context.height}"
        fault = f"states {size} pixels, more than it can have; make its images smaller"
    else:
        context.options = {**context.options, "max_pixels": str(most)}  # a size may change later
    if fault:
        container.close()
        raise InputError(f"{name} {fault}.")
