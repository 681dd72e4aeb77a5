"""Network streams through FFmpeg (PyAV), with a timeout."""

import time
from collections.abc import Generator
from contextlib import suppress

import av
from av.container import InputContainer

from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.io.sources.video_limits import check_decodable, nominal_rate

PATIENCE = 10.0
"""Timeout in seconds after which a stream counts as gone."""
_OPTIONS = {
    "rtsp_transport": "tcp",
    # No stream may lead to a file of this machine.
    "protocol_whitelist": "rtsp,rtsps,rtp,srtp,rtmp,rtmps,http,https,httpproxy,tls,tcp,udp,crypto",
}


class NetworkStream:
    """Feed of a camera or a server in the network."""

    def __init__(self, address: LiveAddress) -> None:
        """Raises InputError if it cannot be opened or gives no image."""
        self._address = address
        with self._open() as container:
            stream = container.streams.video[0]
            first = next(_frames(container), None)
            if first is None:
                raise InputError(f"{address.name} is open, but gives no image.")
            fps = nominal_rate(stream.average_rate or stream.guessed_rate)
            self.info = RecordingInfo(address.kind, address.name, first.width, first.height, fps)

    def frames(self) -> Generator[RawFrame, None, None]:
        """Images from now on, with their time of arrival in seconds since the start."""
        with self._open() as container:
            began = time.monotonic()
            for number, frame in enumerate(_frames(container)):
                image = frame.to_ndarray(format="rgb24")
                now = time.monotonic() - began
                yield RawFrame(f"{self.info.name}, frame {number}", now, image)

    def _open(self) -> InputContainer:
        name = self._address.name
        try:
            container = av.open(self._address.target, timeout=PATIENCE, options=_OPTIONS)
        except (av.error.FFmpegError, OSError, ValueError):
            raise InputError(f"{name} cannot be opened; is it reachable?") from None
        if not container.streams.video:
            container.close()
            raise InputError(f"{name} is open, but gives no image.")
        check_decodable(container, name)
        return container


def _frames(container: InputContainer) -> Generator[av.VideoFrame, None, None]:
    """Images until the stream ends or is gone; damaged ones are left out."""
    with suppress(av.error.FFmpegError, OSError):
        for packet in container.demux(container.streams.video[0]):
            with suppress(av.error.FFmpegError):
                yield from packet.decode()
