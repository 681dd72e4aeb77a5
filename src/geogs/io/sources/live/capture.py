"""Cameras and streams of the network through OpenCV."""

import time
from collections.abc import Generator

import cv2

from geogs.errors import InputError
from geogs.io.sources.address import LiveAddress
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.reader import RawFrame

MOST_MISSED = 30
"""Images in a row that do not come before a camera counts as gone."""


class Capture:
    """A camera of this machine, or a stream."""

    def __init__(self, address: LiveAddress) -> None:
        """Raises InputError if it cannot be opened or gives no image."""
        self.kind: str = address.kind
        self.name = address.name
        self._target: int | str = address.target
        if address.kind == "camera":
            self._target = int(address.target)
        self.calibration: Calibration | None = None
        capture = self._open()
        try:
            is_there, image = capture.read()
            if not is_there or image is None:
                raise InputError(f"{self.name} is open, but gives no image.")
            self.height, self.width = image.shape[:2]
            nominal = float(capture.get(cv2.CAP_PROP_FPS))
            self.fps = nominal if 1.0 <= nominal <= 1000.0 else 30.0
        finally:
            capture.release()

    def frames(self) -> Generator[RawFrame, None, None]:
        """Images from now on, with the seconds since the first at which they came."""
        capture, missed, number = self._open(), 0, 0
        began = time.monotonic()
        try:
            while missed < MOST_MISSED:
                is_there, image = capture.read()
                if not is_there or image is None:
                    missed += 1
                    time.sleep(1 / self.fps)
                    continue
                missed, now = 0, time.monotonic() - began
                rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                yield RawFrame(f"{self.name}, frame {number}", now, rgb)
                number += 1
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(self._target)
        if not capture.isOpened():
            capture.release()
            which = "plugged in, and used by nothing else" if self.kind == "camera" else "reachable"
            raise InputError(f"{self.name} cannot be opened; is it {which}?")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # no queue before ours, where the driver obeys
        return capture
