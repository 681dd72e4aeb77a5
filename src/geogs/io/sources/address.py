"""Addresses of live sources: a camera, a network stream, a pipe, a file played at its pace."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

_NETWORK = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp):/{1,2}(?=[^/])(.+)", re.DOTALL)
_CAMERA = re.compile(r"camera:(\d{1,3})")
_PLAY = re.compile(r"play:(.+)", re.DOTALL)


@dataclass(frozen=True)
class LiveAddress:
    """Address of a live source."""

    kind: Literal["camera", "stream", "pipe", "play"]
    target: str
    """Number of the camera, URL, path of the file; empty for the pipe."""

    @property
    def name(self) -> str:
        """Name in messages and folders: without the user and password of an URL."""
        if self.kind == "camera":
            return f"camera-{self.target}"
        if self.kind == "play":
            return f"{Path(self.target).name} (played)"
        if self.kind == "pipe":
            return "pipe"
        host = re.split(r"[/?#]", self.target.split("://", 1)[1], maxsplit=1)[0]
        return f"stream-{re.sub(r'[^A-Za-z0-9.-]', '-', host.rsplit('@', 1)[-1])}"


def live_address(source: str | Path) -> LiveAddress | None:
    """The address ``camera:0``, ``rtsp://…``, ``-`` or ``play:FILE``; none where it is a path.

    A path made of an URL has lost one of its slashes; it still counts as an URL. A file that has
    such a name is a file.
    """
    words = str(source)
    if words != "-" and os.path.isfile(words):
        return None
    if words == "-":
        return LiveAddress("pipe", "")
    if found := _CAMERA.fullmatch(words):
        return LiveAddress("camera", str(int(found[1])))
    if found := _NETWORK.fullmatch(words):
        return LiveAddress("stream", f"{found[1]}://{found[2]}")
    if found := _PLAY.fullmatch(words):
        return LiveAddress("play", found[1])
    return None
