"""Cameras of this machine through OpenCV, by their drivers and not by its FFmpeg."""

import time
from collections.abc import Generator

import cv2

from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.reader import RawFrame, RecordingInfo
from geogs.io.sources.video_limits import nominal_rate

MOST_MISSED = 30
"""Number of missed images in a row after which a camera counts as gone."""


class Capture:
    """A camera of this machine."""

    def __init__(self, address: LiveAddress) -> None:
        """Raises InputError if it cannot be opened or gives no image."""
        self._address = address
        capture = self._open()
        try:
            is_there, image = capture.read()
            if not is_there or image is None:
                raise InputError(f"{address.name} is open, but gives no image.")
            height, width = image.shape[:2]
            fps = nominal_rate(capture.get(cv2.CAP_PROP_FPS))
            self.info = RecordingInfo(address.kind, address.name, width, height, fps)
        finally:
            capture.release()

    def frames(self) -> Generator[RawFrame, None, None]:
        """Images from now on, with their time of arrival in seconds since the start."""
        capture = self._open()
        missed = 0
        number = 0
        began = time.monotonic()
        try:
            while missed < MOST_MISSED:
                is_there, image = capture.read()
                if not is_there or image is None:
                    missed += 1
                    time.sleep(1 / self.info.fps)
                    continue
                missed = 0
                now = time.monotonic() - began
                rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                yield RawFrame(f"{self.info.name}, frame {number}", now, rgb)
                number += 1
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(int(self._address.target))
        if not capture.isOpened():
            capture.release()
            name = self._address.name
            raise InputError(
                f"{name} cannot be opened; is it plugged in, and used by nothing else?"
            )
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # no queue before ours, if the driver supports it
        return capture
