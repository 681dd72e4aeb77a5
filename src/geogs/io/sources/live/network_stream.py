"""Network streams through FFmpeg (PyAV), with a timeout."""

import logging
import time
from collections.abc import Generator
from contextlib import suppress
from http.client import HTTPException

import av
from av.container import InputContainer

from geogs.errors import InputError
from geogs.guard.same_host import SameHost
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.live.live_reader import Latest
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.io.sources.video_limits import check_decodable, nominal_rate, video_formats

_log = logging.getLogger(__name__)
PATIENCE = 10.0
"""Timeout in seconds after which a stream counts as gone."""
_OPTIONS = {
    "rtsp_transport": "tcp",
    "max_redirects": "0",
    "http_persistent": "0",  # FFmpeg would abort, as Python opens what play lists name
    # No stream may lead to a file of this machine.
    "protocol_whitelist": "rtsp,rtsps,rtp,srtp,rtmp,rtmps,http,https,httpproxy,tls,tcp,udp,crypto",
}


class NetworkStream:
    """Feed of a camera or a server in the network."""

    def __init__(self, address: LiveAddress) -> None:
        """Raises InputError if it cannot be opened or gives no image."""
        self._address = address
        # Signals are handled while a thread waits for the server.
        opening = Latest(self._described())
        found = opening.take()
        assert found is not None, "an error is raised by take"
        self.info = found
        opening.close()  # a camera may allow one connection alone

    def frames(self) -> Generator[RawFrame, None, None]:
        """Images from now on, with their time of arrival in seconds since the start."""
        with self._open() as container:
            began = time.monotonic()
            for number, frame in enumerate(_frames(container)):
                image = frame.to_ndarray(format="rgb24")
                now = time.monotonic() - began
                yield RawFrame(f"{self.info.name}, frame {number}", now, image)

    def _described(self) -> Generator[RecordingInfo, None, None]:
        kind, name = self._address.kind, self._address.name
        with self._open() as container:
            stream = container.streams.video[0]
            first = next(_frames(container), None)
            if first is None:
                raise InputError(f"{name} is open, but gives no image.")
            fps = nominal_rate(stream.average_rate or stream.guessed_rate)
            yield RecordingInfo(kind, name, first.width, first.height, fps)

    def _open(self) -> InputContainer:
        name, target = self._address.name, self._address.target
        is_web = target.startswith(("http://", "https://"))
        is_list = is_web and target.partition("?")[0].endswith((".m3u8", ".m3u"))
        same_host = SameHost(target, name, PATIENCE)
        options = {**_OPTIONS, "format_whitelist": video_formats("hls" if is_list else "rtsp")}
        if is_web and av.library_versions["libavformat"] < (62, 12):  # it knows no max_redirects
            same_host.refuse_redirection()
        try:
            container = av.open(
                target, timeout=PATIENCE, options=options, io_open=same_host if is_list else None
            )
        except (av.error.FFmpegError, OSError, ValueError, HTTPException) as error:
            if is_web and not isinstance(error, av.error.ExitError):  # it has answered
                same_host.refuse_redirection()
            raise InputError(f"{name} cannot be opened; is it reachable, and a video?") from None
        if not container.streams.video:
            container.close()
            raise InputError(f"{name} is open, but gives no image.")
        check_decodable(container, name)
        return container


def _frames(container: InputContainer) -> Generator[av.VideoFrame, None, None]:
    """Images until the stream ends, is gone or leads elsewhere; damaged ones are left out."""
    try:
        for packet in container.demux(container.streams.video[0]):
            with suppress(av.error.FFmpegError):
                yield from packet.decode()
    except InputError as error:
        _log.warning("%s", error)
    except (av.error.FFmpegError, OSError, ValueError, HTTPException):
        return
